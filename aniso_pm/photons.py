"""Light paths → photon map.

Each of N light paths starts at an emitter with the flux that Mitsuba's emitter sampling gives it
(whose mean over paths is the scene's emitted power) and is followed through the scene by BSDF
sampling. At every receiver (see ``needs``) that it meets after at least one bounce, a photon is
stored: position, normal of the side it came from, flux. Direct light is not stored; it is sampled
from the eye.

Shading normals make light transport asymmetric. At a bounce the importance-transport factor
|(wi·n_s)(wo·n_g)| / |(wo·n_s)(wi·n_g)| is applied [Veach 1997, Sec. 5.3]; at a deposit the
receiver's cosine is that of the shading normal, while flux arrives per geometric area, so the
photon carries the factor |wi·n_s| / |wi·n_g|.

Photons are counted while they are stored. If a buffer turns out too small it is enlarged to the
count and the same paths are traced again: none is ever lost.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from . import index as spatial
from .needs import receiver_reflectance
from .rays import largest_coordinate, spawn_ray

# Light paths traced at once: bounds the memory of a wavefront, not the number of photons.
WAVEFRONT = 1 << 21
# Photons a path for the first guess of the buffer size; later maps start from the last count.
_FIRST_GUESS = 2.0


@dataclass(frozen=True)
class PhotonMap:
    """Photons in the order of their spatial index.

    emitted    light paths traced: the estimate divides by it.
    stored     photons in the map; 0 means that ``index`` and ``flux`` are None.
    rejected   fluxes that were not finite and were dropped: photons, and light paths that end.
    index      word of a point: octahedral normal in 24 bits, number of path segments in 8.
    flux       W, interleaved channels, padded to a power of two.
    """

    emitted: int
    stored: int
    rejected: int
    index: Any
    flux: Any


def build_map(
    scene, photon_count: int, seed: int, max_depth: int, rr_depth: int, expected: int = 0
):
    """Trace ``photon_count`` light paths and index what they leave.

    max_depth  path segments of the longest light path that is stored (at least 2 to store any).
    rr_depth   path segments after which Russian roulette begins.
    expected   photons that an earlier map of the same scene stored (sizes the buffers).
    """
    buffers = _trace(
        scene, photon_count, seed, max_depth, rr_depth, expected or int(_FIRST_GUESS * photon_count)
    )
    stored, rejected, position, word, flux = buffers
    if stored == 0:
        return PhotonMap(photon_count, 0, rejected, None, None)
    used = dr.arange(mi.UInt32, stored)
    index = spatial.build(dr.gather(mi.Point3f, position, used), dr.gather(mi.UInt32, word, used))
    width = _flux_width()
    sorted_flux = dr.empty(mi.Float, stored * width)
    packed = dr.gather(_packet(), flux, index.order)
    dr.scatter(sorted_flux, packed, used)
    dr.eval(sorted_flux)
    return PhotonMap(photon_count, stored, rejected, index, sorted_flux)


def photon_flux(photons: PhotonMap, slot, active):
    """Flux (mi.Spectrum, W) of the photon in a slot."""
    packed = dr.gather(_packet(), photons.flux, slot, active)
    return mi.Spectrum(*(packed[k] for k in range(dr.size_v(mi.Spectrum))))


def _flux_width() -> int:
    return 1 if dr.size_v(mi.Spectrum) == 1 else 4


def _packet():
    """Array type of one photon's flux: a power of two of channels is gathered at once."""
    return mi.Vector1f if _flux_width() == 1 else mi.Vector4f


def encode_normal(n):
    """Unit vector → 24 bits (octahedral, 12 bits a coordinate: within 0.07 degrees)."""
    n = n / (dr.abs(n.x) + dr.abs(n.y) + dr.abs(n.z))
    fold_x = dr.mulsign(1 - dr.abs(n.y), n.x)
    fold_y = dr.mulsign(1 - dr.abs(n.x), n.y)
    x, y = dr.select(n.z < 0, fold_x, n.x), dr.select(n.z < 0, fold_y, n.y)
    quantise = lambda v: mi.UInt32(dr.clip((0.5 * v + 0.5) * 4095 + 0.5, 0, 4095))  # noqa: E731
    return quantise(x) | (quantise(y) << 12)


def decode_normal(word):
    """Inverse of ``encode_normal``; higher bits of the word are ignored."""
    x = mi.Float(word & 0xFFF) * (2 / 4095) - 1
    y = mi.Float((word >> 12) & 0xFFF) * (2 / 4095) - 1
    z = 1 - dr.abs(x) - dr.abs(y)
    fold = dr.maximum(-z, 0)
    return dr.normalize(mi.Vector3f(x - dr.mulsign(fold, x), y - dr.mulsign(fold, y), z))


def segments(word):
    """Number of path segments from the light to the photon (255 stands for 255 and more)."""
    return word >> 24


def _trace(scene, photon_count, seed, max_depth, rr_depth, capacity):
    """(stored, rejected, position, word, flux) with buffers of at least ``stored`` entries."""
    while True:
        capacity = max(capacity + capacity // 16, 1024)
        position = dr.empty(mi.Point3f, capacity)
        word = dr.empty(mi.UInt32, capacity)
        flux = dr.empty(mi.Float, capacity * _flux_width())
        stored, rejected = dr.zeros(mi.UInt32, 1), dr.zeros(mi.UInt32, 1)
        for first in range(0, photon_count, WAVEFRONT):
            sampler = mi.load_dict({"type": "independent"})
            sampler.seed(
                mi.sample_tea_32(seed, first // WAVEFRONT)[0], min(WAVEFRONT, photon_count - first)
            )
            _trace_wavefront(
                scene,
                sampler,
                max_depth,
                rr_depth,
                capacity,
                stored,
                rejected,
                position,
                word,
                flux,
            )
            dr.eval(position, word, flux, stored, rejected)
        count = int(stored[0])
        if count <= capacity:
            return count, int(rejected[0]), position, word, flux
        capacity = count


@dr.syntax
def _trace_wavefront(
    scene, sampler, max_depth, rr_depth, capacity, stored, rejected, position, word, flux
):
    ctx = mi.BSDFContext(mi.TransportMode.Importance)
    capacity = dr.opaque(mi.UInt32, capacity)
    max_depth, rr_depth = dr.opaque(mi.UInt32, max_depth), dr.opaque(mi.UInt32, rr_depth)
    reach = dr.opaque(mi.Float, largest_coordinate(scene))

    # --- Leave the emitter ---
    ray, emitted, _ = scene.sample_emitter_ray(
        mi.Float(0), sampler.next_1d(), sampler.next_2d(), sampler.next_2d(), True
    )
    finite = dr.isfinite(dr.sum(emitted))
    dr.scatter_add(rejected, mi.UInt32(1), mi.UInt32(0), ~finite)
    ray = mi.Ray3f(ray)  # Current ray
    β = mi.Spectrum(1)  # Path throughput, shading-normal corrections included
    η = mi.Float(1)  # Relative index of refraction along the path
    depth = mi.UInt32(1)  # Path segments up to the next vertex
    active = finite & (dr.max(emitted) > 0)

    while active:
        # --- Find the next vertex ---
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        bsdf = si.bsdf()
        wi_n, wi_s = dr.abs(dr.dot(ray.d, si.n)), dr.abs(mi.Frame3f.cos_theta(si.wi))
        # Where shading and geometric normal disagree about the side nothing is stored (no leaks).
        same_side = (dr.dot(-ray.d, si.n) * mi.Frame3f.cos_theta(si.wi)) > 0

        # --- Leave a photon ---
        is_receiver, reflectance = receiver_reflectance(bsdf, si, active)
        power = emitted * β * (wi_s / wi_n)
        deposit = active & is_receiver & same_side & (depth >= 2) & (dr.max(reflectance) > 0)
        finite = dr.all(dr.isfinite(power))
        dr.scatter_add(rejected, mi.UInt32(1), mi.UInt32(0), deposit & ~finite)
        deposit &= finite & (dr.max(power) > 0)
        slot = dr.scatter_inc(stored, mi.UInt32(0), deposit)
        deposit &= slot < capacity
        side = dr.mulsign(mi.Normal3f(si.n), dr.dot(-ray.d, si.n))
        dr.scatter(position, si.p, slot, deposit)
        dr.scatter(
            word, encode_normal(side) | (dr.minimum(depth, mi.UInt32(255)) << 24), slot, deposit
        )
        dr.scatter(flux, _pack(power), slot, deposit)

        # --- Scatter ---
        active &= depth < max_depth
        bs, weight = bsdf.sample(ctx, si, sampler.next_1d(active), sampler.next_2d(active), active)
        wo = si.to_world(bs.wo)
        wo_n, wo_s = dr.dot(wo, si.n), mi.Frame3f.cos_theta(bs.wo)
        # A reflection through the geometric surface would leak, and its correction has no bound.
        reflected = mi.Frame3f.cos_theta(si.wi) * wo_s > 0
        active &= ~reflected | (same_side & (wo_n * wo_s > 0))
        active &= ~dr.all(weight == 0)  # failed samples have no direction to correct for
        correction = dr.abs((wi_s * wo_n) / (wo_s * wi_n))
        β *= weight * correction
        η *= bs.eta
        broken = active & ~dr.all(dr.isfinite(β))
        dr.scatter_add(rejected, mi.UInt32(1), mi.UInt32(0), broken)
        active &= ~broken & (dr.max(β) > 0)

        # --- Russian roulette, on the throughput alone: independent of the emitters' power ---
        survive = dr.minimum(dr.max(β) * η * η, 0.95)
        roulette = depth >= rr_depth
        active &= ~roulette | (sampler.next_1d(active) < survive)
        β[roulette] = β * dr.rcp(survive)

        ray = spawn_ray(si, wo, reach)
        depth += 1


def _pack(spectrum):
    channels = [spectrum[k] for k in range(dr.size_v(mi.Spectrum))]
    return _packet()(*(channels + [mi.Float(0)] * (_flux_width() - len(channels))))
