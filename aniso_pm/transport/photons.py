"""Light paths → photon map.

Each of N light paths starts at an emitter with the flux that Mitsuba's emitter sampling gives it
(whose mean over paths is the scene's emitted power) and is followed through the scene by BSDF
sampling. At every receiver (see ``receivers``) that it meets after at least one bounce, a photon is
stored: position, normal of the side it came from, flux, and its direction where a receiver needs
it. Direct light is not stored; it is sampled from the eye.

A *caustic* photon comes over walked parts of BSDFs only. Where the map has to tell, every bounce
decides at random which part it belongs to, by their shares in the sampled direction.

Shading normals make light transport asymmetric. At a bounce the importance-transport factor
|(wi·n_s)(wo·n_g)| / |(wo·n_s)(wi·n_g)| is applied [Veach 1997, Sec. 5.3]; at a deposit the
receiver's cosine is that of the shading normal, while flux arrives per geometric area, so the
photon carries the factor |wi·n_s| / |wi·n_g|.

At bump and normal maps the BSDF is weighted as the viewer evaluates it (see ``bent``).

Light paths begin evenly over what emitters emit, or where they are told to (see ``aim``).

Photons are counted while they are stored. If a buffer turns out too small it is enlarged to the
count and the same paths are traced again: none is ever lost.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .. import arrays
from ..map import index as spatial
from ..map.glossy_caustics import EmitterDensity, seen_from
from ..map.photon_map import Origins, PhotonMap, Photons, indexed
from ..map.photon_word import CAUSTIC, GLOSSY_ALONE, SEGMENTS_MAX, encode, encode_normal
from ..map.receivers import gathered_part, read_bent, read_receiver
from ..map.spectra import channel_mean
from .aim import Aim
from .bent import bent_bounce, viewed
from .emission import Emission, only_photons_see
from .rays import reach_of, spawn_ray

# Light paths traced at once: bounds the memory of a wavefront, not the number of photons.
WAVEFRONT = 1 << 21
# Photons a path that there is room for at least: buffers of one size are traced and replayed once.
_ROOM = 2.0


@dataclass  # not frozen: Dr.Jit writes back whatever a loop mentions
class TraceOptions:
    """Decisions for one scene; what is off is neither traced nor stored.

    max_depth     segments of the longest light path that is stored (at least 2 to store any).
    rr_depth      segments after which Russian roulette begins.
    caustics      "ignored", "marked" in the photons' words, or "only" those are stored.
    general       the scene has receivers that are not Lambertian: keep directions.
    roughness     smallest alpha that is gathered on.
    unseen_light  the scene has direct light that only photons can find.
    bent          the scene has bump or normal maps.
    glossy        density of drawing emitters, where photons are kept for glossy caustics (see
                  ``glossy_caustics``); else None.
    wavelengths   nm, of all photons (spectral variants), else None.
    aim           aim.Aim, where light paths do not begin evenly.
    remember      the map is to know where its light paths began (PhotonMap.origins).
    """

    max_depth: int
    rr_depth: int
    caustics: str
    general: bool
    roughness: float
    unseen_light: bool
    bent: bool
    glossy: EmitterDensity | None = None
    wavelengths: Any = None
    aim: Aim | None = None
    remember: bool = False


def build_map(
    scene,
    source: Emission,
    photon_count: int,
    seed: int,
    options: TraceOptions,
    expected: int = 0,
    launch=None,
    lap=lambda stage: None,
    wavefront: int | None = None,
):
    """Trace ``photon_count`` light paths from ``source`` and index what they leave.

    expected  photons to make room for; with too little room the same paths are traced again.
    launch    ``light_paths``, or that function frozen.
    lap       called with the name of each stage that ends.
    wavefront  light paths traced at once; None: WAVEFRONT.
    """
    room = max(expected, int(_ROOM * photon_count))
    stored, rejected, photons = _trace(
        scene,
        source,
        photon_count,
        seed,
        options,
        room,
        launch or light_paths,
        wavefront or WAVEFRONT,
    )
    lap("photons")
    nothing = PhotonMap(photon_count, 0, rejected, *[None] * 4)
    if options.remember:
        nothing = replace(nothing, origins=Origins(None, _beginnings(seed, photon_count)))
    map_ = indexed(photons, stored, nothing)
    lap("index")
    return replace(map_, wavelengths=options.wavelengths)


def _trace(scene, source, photon_count, seed, options, capacity, launch, wavefront):
    """(stored, rejected, Photons with buffers of at least ``stored`` entries)."""
    while True:
        capacity = max(capacity + capacity // 16, 1024)
        photons = Photons(
            arrays.room(mi.Point3f, capacity),
            arrays.room(mi.UInt32, capacity),
            arrays.room(mi.Spectrum, capacity),
            arrays.room(mi.UInt32, capacity) if options.general or options.glossy else None,
            arrays.room(mi.UInt32, capacity) if options.remember else None,
            arrays.room(mi.Float, capacity) if options.glossy else None,
        )
        stored, rejected = dr.opaque(mi.UInt32, 0), dr.opaque(mi.UInt32, 0)
        room = dr.opaque(mi.UInt32, capacity)
        for first in range(0, photon_count, wavefront):
            count = min(wavefront, photon_count - first)
            sampler = _random(seed, first // wavefront, count)
            # A number would be part of what is recorded, and replayed for other wavefronts.
            share = dr.opaque(mi.Float, 1 / count)
            photons, stored, rejected = launch(
                scene, source, sampler, share, options, photons, stored, rejected, room
            )
            dr.eval(photons, stored, rejected)
        count = int(stored[0])
        if count <= capacity:
            return count, int(rejected[0]), photons
        capacity = count
        del photons
        spatial.give_back(count)


def _random(seed: int, wavefront: int, count: int):
    """Sampler of the light paths of a wavefront."""
    sampler = mi.load_dict({"type": "independent"})
    own = mi.sample_tea_32(seed, wavefront)[0]
    sampler.seed(dr.opaque(mi.UInt32, own), count)
    return sampler


def _beginnings(seed: int, count: int) -> np.ndarray:
    """The numbers with which light paths of the first wavefront begin, (paths, 5)."""
    u1, u2, u3 = _first_numbers(_random(seed, 0, count))
    return np.stack([v.numpy() for v in (u1, u2.x, u2.y, u3.x, u3.y)], 1)


def _first_numbers(sampler):
    """For emitter, place, direction."""
    return sampler.next_1d(), sampler.next_2d(), sampler.next_2d()


def light_paths(scene, source, sampler, share, options, photons, stored, rejected, room):
    """One wavefront of light paths into the buffers; returns what it has changed. share: of one
    path in the wavefront."""

    def reject(active):
        dr.scatter_add(rejected, mi.UInt32(1), mi.UInt32(0), active)

    def store(position, word, flux, direction, path, density, active):
        slot = dr.scatter_inc(stored, mi.UInt32(0), active)
        active = active & (slot < room)
        dr.scatter(photons.position, position, slot, active)
        dr.scatter(photons.word, word, slot, active)
        dr.scatter(photons.flux, flux, slot, active)
        if options.glossy:
            dr.scatter(photons.emitter_density, density, slot, active)
        if options.general or options.glossy:
            dr.scatter(photons.direction, encode(direction, 16), slot, active)
        if options.remember:
            dr.scatter(photons.path, path, slot, active)

    _trace_wavefront(scene, source, sampler, share, options, store, reject)
    return photons, stored, rejected


@dr.syntax
def _trace_wavefront(scene, source, sampler, share, options, store, reject):
    ctx = mi.BSDFContext(mi.TransportMode.Importance)
    o = options
    max_depth, rr_depth = dr.opaque(mi.UInt32, o.max_depth), dr.opaque(mi.UInt32, o.rr_depth)
    reach = dr.opaque(mi.Float, reach_of(scene))

    ray, emitted, emitter, path, shortest, finite = _leave_emitter(source, sampler, share, o)
    reject(~finite)
    ray = mi.Ray3f(ray)  # Current ray
    β = mi.Spectrum(1)  # Path throughput, shading-normal corrections included
    η = mi.Float(1)  # Relative index of refraction along the path
    depth = mi.UInt32(1)  # Path segments up to the next vertex
    caustic = mi.Bool(True)  # Walked parts of BSDFs only, so far
    active = finite & (dr.max(emitted) > 0)
    delta_only = mi.Bool(True)  # Delta lobes only, so far
    length = mi.Float(0)  # Of the path
    density, per_area = mi.Float(0), mi.Bool(False)  # Of drawing its beginning
    if dr.hint(o.glossy is not None, mode="scalar"):
        density, per_area = o.glossy.at(emitter, -ray.d, active)

    while dr.hint(active, label="light paths"):
        # --- Find the next vertex ---
        si = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        bsdf = si.bsdf()
        # Mirrored rectangles and cubes, and meshes wound against their vertex normals, have it on
        # the other side than the shading normal, which is what BSDFs know (but for bump maps, which
        # turn theirs to si.n: that stays).
        n = dr.mulsign(si.n, dr.dot(si.n, si.sh_frame.n))
        wi_n, wi_s = dr.abs(dr.dot(ray.d, n)), dr.abs(mi.Frame3f.cos_theta(si.wi))
        # Where shading and geometric normal disagree about the side nothing is stored (no leaks).
        same_side = (dr.dot(-ray.d, n) * mi.Frame3f.cos_theta(si.wi)) > 0

        # --- Leave a photon ---
        is_receiver, lambertian, _, keeps, glossy = read_receiver(
            bsdf, si, o.roughness, o.general, active, "somewhere" if o.glossy else ""
        )
        power = emitted * β * (wi_s / wi_n)
        deposit = active & keeps & same_side & (depth >= shortest)
        if dr.hint(o.caustics == "only", mode="scalar"):
            deposit &= caustic
        seen_directly = mi.Float(0)
        if dr.hint(o.glossy is not None, mode="scalar"):
            length += dr.select(active, si.t, 0)
            glossy &= active & same_side & delta_only & (depth >= 2)
            seen_directly = dr.select(glossy, seen_from(density, per_area, length), 0)
        received = mi.Bool(deposit)  # not the same array, which changes in place
        deposit |= glossy
        finite = dr.all(dr.isfinite(power))
        reject(deposit & ~finite)
        deposit &= finite & (dr.max(power) > 0)
        side = dr.mulsign(mi.Normal3f(n), dr.dot(-ray.d, n))
        word = encode_normal(side) | (dr.minimum(depth, SEGMENTS_MAX) << 24)
        if dr.hint(o.caustics == "marked", mode="scalar"):
            word |= dr.select(caustic, mi.UInt32(CAUSTIC), mi.UInt32(0))
        if dr.hint(o.glossy is not None, mode="scalar"):
            word |= dr.select(received, mi.UInt32(0), mi.UInt32(GLOSSY_ALONE))
        store(si.p, word, power, -ray.d, path, seen_directly, deposit)

        # --- Scatter ---
        active &= depth < max_depth
        bs, weight = bsdf.sample(ctx, si, sampler.next_1d(active), sampler.next_2d(active), active)
        bent = mi.Bool(False)
        if dr.hint(o.bent, mode="scalar"):
            bent = read_bent(bsdf, active)
            bs, bent_weight = bent_bounce(ctx, bsdf, si, bs, weight, sampler, bent)
            weight = dr.select(bent, bent_weight, weight)
        if dr.hint(o.glossy is not None, mode="scalar"):
            delta_only &= mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        wo = si.to_world(bs.wo)
        wo_n, wo_s = dr.dot(wo, n), mi.Frame3f.cos_theta(bs.wo)
        # A reflection through the geometric surface would leak, and its correction has no bound.
        reflected = mi.Frame3f.cos_theta(si.wi) * wo_s > 0
        active &= ~reflected | (same_side & (wo_n * wo_s > 0))
        active &= ~dr.all(weight == 0)  # failed samples have no direction to correct for
        β *= weight * dr.abs(wo_n / wi_n) * dr.select(bent, 1, dr.abs(wi_s / wo_s))
        η *= bs.eta

        # --- Which part of the BSDF was it? ---
        if dr.hint(o.caustics != "ignored", mode="scalar"):
            gathers = is_receiver
            if dr.hint(o.general, mode="scalar"):
                mixed = is_receiver & ~lambertian
                g = _gathered_share(si, bsdf, bs, o.roughness, mixed)
                chance = channel_mean(g)
                gathers = is_receiver & (lambertian | (sampler.next_1d(active) < chance))
                part = dr.select(gathers, g / chance, (1 - g) / (1 - chance))
                β = dr.select(mixed, β * part, β)
            caustic &= ~gathers
            if dr.hint(o.caustics == "only", mode="scalar"):
                active &= caustic
        broken = active & ~dr.all(dr.isfinite(β))
        reject(broken)
        active &= ~broken & (dr.max(β) > 0)

        # --- Russian roulette, on the throughput alone: independent of the emitters' power ---
        survive = dr.minimum(dr.max(β) * η * η, 0.95)
        roulette = depth >= rr_depth
        active &= ~roulette | (sampler.next_1d(active) < survive)
        β[roulette] = β * dr.rcp(survive)

        ray = spawn_ray(si, wo, reach)
        depth += 1


def _leave_emitter(source, sampler, share, o):
    """(ray, flux, emitter, number of the path, segments of the shortest path that is stored, is the
    flux finite?) of every path."""
    numbers = _first_numbers(sampler)
    path = dr.arange(mi.UInt32, dr.width(numbers[0]))
    worth = mi.Float(1)
    if o.aim is not None:
        # Stratified: path k of n chooses between k/n and (k + 1)/n.
        *numbers, worth = o.aim((mi.Float(path) + sampler.next_1d()) * share, *numbers)
    ray, emitted, emitter = source.sample_ray(mi.Float(0), *numbers, wavelengths=o.wavelengths)
    emitted *= worth
    shortest = mi.UInt32(2)
    if o.unseen_light:
        shortest = dr.select(only_photons_see(emitter), mi.UInt32(1), mi.UInt32(2))
    return ray, emitted, emitter, path, shortest, dr.all(dr.isfinite(emitted))


def _gathered_share(si, bsdf, bs, roughness, mixed):
    """Share of the gathered part in the sampled direction, as the viewer sees it, 0 to 1 in each
    channel; mixed: lanes whose BSDF may have both parts."""
    smooth = mixed & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
    seen = viewed(si, bs.wo)
    f_g = gathered_part(bsdf, seen, si.wi, roughness, smooth)
    f = bsdf.eval(mi.BSDFContext(), seen, si.wi, smooth)
    return mi.Spectrum(dr.select(smooth & (f > 0), dr.clip(f_g / f, 0, 1), 0))
