"""Photon map → sums over the nodes of its index, for kernels that hold hundreds of photons.

A node that lies inside a kernel and is small in the kernel's own coordinates counts as one photon
of its whole flux at its centroid. With half extents x, y in units of the axes, the weight
w = exp(−ρ²) differs from its value at the centroid by a first-order term, whose flux-weighted mean
over the node vanishes, and by a second-order term of at most x² + y² in the mean: the Hessian of w
has no eigenvalue beyond 2, and no variance exceeds the square of half the range. Colours have
centroids of their own; what they are apart is bounded by √(2/e), the steepest slope of w. With

    x² + y² <= tolerance/2,    √(2/e) |distance of the colours' centroids| <= tolerance/2

for all nodes that are taken, the sum over a kernel is off by at most ``tolerance`` times the flux
of the photons that it meets, in every colour. Nodes through which the kernel's rim goes are taken
where there is room in the first half for the weight at the rim, e⁻⁴.

A node whose photons do not all face the same way, or do not all stand at the same place in their
paths where that matters, is never taken.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import reduce
from typing import Any

import drjit as dr
import mitsuba as mi

from . import photon_word
from .gather_points import take
from .index import LEAF, Ellipses
from .photon_map import PhotonMap, flux_bytes, pack_flux, photon_flux, read_flux

# Normals of a node are taken for one where they lie in a box of this half diagonal (11 degrees).
_SPREAD = 0.2
# Their middle must face the receiver within 41 − 12 degrees, so that each of them does within 41.
_COSINE = 0.875
_STEEPEST = math.sqrt(2 / math.e)


@dataclass(frozen=True)
class Sums:
    """Of each node, in heap order.

    flux    sum over its photons, channels as in ``PhotonMap.flux``.
    place   centroid (at infinity: never to be taken) and word, interleaved; the word has the middle
            of the normals, the most segments, and the caustic bit if all photons have it.
    spread  largest distance of a colour's centroid from it, world units.
    """

    flux: Any
    place: Any
    spread: Any


def build(map_: PhotonMap) -> Sums:
    """Sums of a photon map of at least one photon."""
    level = map_.index.n_leaves
    width = flux_bytes() // 4
    flux, place = dr.zeros(mi.Float, 2 * level * width), dr.zeros(mi.Float, 8 * level)
    spread = dr.zeros(mi.Float, 2 * level)
    node = _leaves(map_)
    while True:
        slot = dr.arange(mi.UInt32, level) + level
        centroid, apart = _centroid(node)
        dr.scatter(flux, pack_flux(node.flux), slot)
        dr.scatter(place, mi.Vector4f(*centroid, dr.reinterpret_array(mi.Float, _word(node))), slot)
        dr.scatter(spread, apart, slot)
        dr.eval(flux, place, spread, node)
        if level == 1:
            return Sums(flux, place, spread)
        level //= 2
        left = 2 * dr.arange(mi.UInt32, level)
        node = _joined(take(node, left), take(node, left + 1))


@dataclass
class _Node:
    """Flux; centroid of each of its channels; corners of the box of normals; most segments; have
    all photons the caustic bit?"""

    flux: Any
    x: Any
    y: Any
    z: Any
    low: Any
    high: Any
    segments: Any
    caustic: Any


def _leaves(map_: PhotonMap) -> _Node:
    index = map_.index
    count = dr.opaque(mi.UInt32, index.count)
    first = LEAF * dr.arange(mi.UInt32, index.n_leaves)

    def photon(k: int) -> _Node:
        exists = first + k < count
        slot = dr.minimum(first + k, count - 1)
        point = dr.gather(mi.Vector4f, index.points, slot)
        word = dr.reinterpret_array(mi.UInt32, point.w)
        normal = photon_word.decode_normal(word)
        # The last photon, again and again without flux, fills up what does not exist.
        # So do those that such sums are not asked for.
        summed = exists & ~photon_word.is_glossy_alone(word)
        flux = dr.select(summed, photon_flux(map_, slot, True), 0)
        x, y, z = (mi.Spectrum(c) for c in (point.x, point.y, point.z))
        steps, caustic = photon_word.segments(word), photon_word.is_caustic(word)
        return _Node(flux, x, y, z, normal, normal, steps, caustic)

    return reduce(_joined, map(photon, range(LEAF)))


def _joined(a: _Node, b: _Node) -> _Node:
    flux = a.flux + b.flux
    share = dr.select(flux > 0, b.flux / flux, 0.5)
    x, y, z = (u + (v - u) * share for u, v in ((a.x, b.x), (a.y, b.y), (a.z, b.z)))
    return _Node(
        flux,
        x,
        y,
        z,
        dr.minimum(a.low, b.low),
        dr.maximum(a.high, b.high),
        dr.maximum(a.segments, b.segments),
        a.caustic & b.caustic,
    )


def _centroid(node: _Node):
    """(centroid, largest distance of a channel's own from it); at infinity where normals differ."""
    share = dr.select(dr.sum(node.flux) > 0, node.flux / dr.sum(node.flux), 1)
    share /= dr.sum(share)
    axes = (node.x, node.y, node.z)
    centroid = mi.Point3f(*(dr.sum(share * c) for c in axes))
    away = sum(dr.square(c - middle) for c, middle in zip(axes, centroid, strict=True))
    away = dr.sqrt(dr.max(dr.select(node.flux > 0, away, 0)))
    alike = dr.norm(node.high - node.low) <= 2 * _SPREAD
    return dr.select(alike, centroid, dr.inf), away


def _word(node: _Node):
    # The box of the normals of photons that face all ways has its middle nowhere.
    middle = node.low + node.high
    middle = dr.select(dr.squared_norm(middle) > 0, middle, mi.Normal3f(0, 0, 1))
    word = photon_word.encode_normal(middle) | (node.segments << 24)
    return word | dr.select(node.caustic, mi.UInt32(photon_word.CAUSTIC), mi.UInt32(0))


def weighed(sums: Sums, node, ellipses: Ellipses, cut2, counts, tolerance):
    """(flux times weight, centroid inside the ellipse?, may it be taken?) of a node.

    counts(word, d, cosine)  does a photon count, if its normal is that near to the receiver's?
    """
    place = dr.gather(mi.Vector4f, sums.place, node)
    d = mi.Vector3f(place.x, place.y, place.z) - ellipses.center
    a, b = dr.dot(ellipses.a, d), dr.dot(ellipses.b, d)
    rho2 = a * a + b * b
    taken = dr.isfinite(rho2) & counts(dr.reinterpret_array(mi.UInt32, place.w), d, _COSINE)
    # x² + y² <= tolerance/2 has been tested; the other half is for the colours.
    steep = dr.maximum(dr.squared_norm(ellipses.a), dr.squared_norm(ellipses.b))
    slack = dr.square(_STEEPEST * dr.gather(mi.Float, sums.spread, node)) * steep
    taken &= slack <= dr.square(0.5 * tolerance)
    flux = read_flux(sums.flux, node, taken)
    inside = taken & (rho2 <= cut2)
    return dr.select(inside, flux * dr.exp(-rho2), 0), inside, taken
