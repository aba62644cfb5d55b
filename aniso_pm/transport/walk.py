"""The walk of an eye path from vertex to vertex.

A path is traced as Mitsuba's ``path`` does (emitter sampling and BSDF sampling, combined by the
power heuristic), but that emitters are drawn by what they may give (see ``direct_light``). What it
leaves to the photon map at a receiver, and where it goes on, depends on how the map is used (see
``uses``).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, NamedTuple

import drjit as dr
import mitsuba as mi

from ..lobe_path import GlossyVertex, follow, no_lobe
from ..map.glossy_caustics import EmitterDensity
from ..map.receivers import gathered_part, read_receiver, shining_pdf
from ..map.spectra import channel_mean
from . import layers
from .chain import Chain
from .direct_light import DirectLight, lit_sides
from .lamps import Lamps
from .rays import reach_of, spawn_ray
from .survey_parts import Apart
from .thinning import Thinning
from .uses import Use


@dataclass  # not frozen: Dr.Jit writes back whatever a loop mentions
class WalkOptions:
    """Decisions for one scene; what is off is not traced.

    use            of the map.
    max_depth      segments of the longest light path.
    rr_depth       segments after which Russian roulette begins.
    min_segments   segments of the shortest light path that the map holds (2; 1 where the scene has
                   direct light that only the map knows).
    hide_emitters  directly visible emitters are invisible.
    gathers        there is a map to be read; without it no gather point is left.
    follow_lobes   keep the anisotropic lobe of the last glossy vertex (``needs.lobes``).
    deep           the scene has surfaces to walk on (``needs.chains``).
    general        the scene has receivers that are not Lambertian (``needs.general``).
    roughness      smallest alpha that is gathered on.
    glossy         density of drawing emitters, where glossy caustics are photons' too (see
                   ``glossy_caustics``); else None.
    measure        keep the length of the path at gather points.
    thinning       which paths leave gather points; None: all do.
    light          split light by how it came (see ``layers``).
    surface        keep what is seen.
    lamps          where emitters are; None: anywhere.
    direct         how emitters are drawn; None: as Mitsuba does.
    """

    use: Use
    max_depth: int
    rr_depth: int
    min_segments: int
    hide_emitters: bool
    gathers: bool
    follow_lobes: bool
    deep: bool
    general: bool
    roughness: float
    glossy: EmitterDensity | None = None
    measure: bool = False
    thinning: Thinning | None = None
    light: bool = False
    surface: bool = False
    lamps: Lamps | None = None
    direct: DirectLight | None = None


class Vertex(NamedTuple):
    """A receiver that a path has met, as ``walk`` hands it to ``leave``.

    lane        of the path; si: the vertex; ray: that arrived there.
    weight      of what is gathered there (with the BRDF, where it is Lambertian).
    depth       path segments from the camera.
    path        GlossyVertex, where lobes are followed.
    lambertian  is its BSDF?
    scattered   has the path left a gathered part before?
    glossy      are glossy caustics seen there?
    distance    from the camera along the path, where that is measured.
    """

    lane: Any
    si: Any
    ray: Any
    weight: Any
    depth: Any
    path: GlossyVertex | None
    lambertian: Any
    scattered: Any
    glossy: Any
    distance: Any


def first_lobe(o: WalkOptions) -> GlossyVertex | None:
    """Of a path that leaves the camera."""
    return no_lobe() if o.follow_lobes else None


@dr.syntax
def walk(scene, sampler, ray, options: WalkOptions, leave, see=None):
    """(radiance, valid) of one wavefront of eye paths, as in ``eye.trace``.

    leave  called as leave(Vertex, active) where paths leave gather points.
    see    called as see(lane, depth, si, bsdf, bs, active, scattered) where paths scatter;
           scattered: have they left a gathered part before?
    """
    ctx = mi.BSDFContext()
    o = options
    max_depth, rr_depth = dr.opaque(mi.UInt32, o.max_depth), dr.opaque(mi.UInt32, o.rr_depth)
    reach = dr.opaque(mi.Float, reach_of(scene))

    ray = mi.Ray3f(ray)  # Current ray
    lane = dr.arange(mi.UInt32, dr.width(ray))
    depth = mi.UInt32(1)  # Path segments up to the vertex that is looked at
    L = mi.Spectrum(0)  # Radiance so far
    β = mi.Spectrum(1)  # Throughput of the path that goes on
    β_direct = mi.Spectrum(1)  # Throughput of emission at the next vertex
    η = mi.Float(1)  # Relative index of refraction along the path
    active = mi.Bool(True)  # Lanes with a path to follow
    valid = mi.Bool(not o.hide_emitters and scene.environment() is not None)  # Anything seen?
    scattered = mi.Bool(False)  # Has the path left a gathered part? ("caustic", "final_gather")
    si_prev = dr.zeros(mi.Interaction3f)  # Last vertex
    chances = o.direct.begin() if o.direct else []  # With which emitters were drawn there
    pdf_prev = mi.Float(1)  # Density of the last BSDF sample
    delta_prev = mi.Bool(True)  # Was it a delta distribution (or the camera)?
    path = first_lobe(o)
    distance = mi.Float(0)  # Length of the path
    trail = layers.begin(o.light, o.surface)  # What it keeps for layers, if anybody asks
    chain = (
        Chain.begin() if o.glossy is not None else None
    )  # Since the last vertex that was not a delta lobe
    apart = Apart.begin() if o.use == "survey" else None  # What the survey tells apart
    chosen, worth = mi.Bool(True), mi.Float(1)  # Does the path gather, and for how many others?
    if dr.hint(o.thinning is not None, mode="scalar"):
        chosen, worth = o.thinning.chosen()

    while dr.hint(active, label="eye paths"):
        # --- Find the next vertex ---
        si = scene.ray_intersect(ray, mi.RayFlags.All, depth == 1, active)
        if dr.hint(o.hide_emitters, mode="scalar"):
            si, ray = _skip_emitters(scene, ray, si, active & (depth == 1))

        # --- Emission, weighted against emitter sampling at the last vertex ---
        ds = mi.DirectionSample3f(scene, si, si_prev)
        seen = active & (ds.emitter != None)  # noqa: E711 (a Dr.Jit comparison)
        if dr.hint(o.hide_emitters, mode="scalar"):
            # As path does: the environment appears once a surface has been seen.
            seen &= valid | si.is_valid()
        pdf_emitter = _light_pdf(scene, o.direct, si_prev, chances, ds, seen & ~delta_prev)
        mis = dr.select(delta_prev, 1, _power_heuristic(pdf_prev, pdf_emitter))
        emission = mis * ds.emitter.eval(si, seen)
        if dr.hint(chain is not None, mode="scalar"):
            chain.length += dr.select(active & si.is_valid(), si.t, 0)
            chance = chain.weight(o.glossy, ds, seen)
            if dr.hint(apart is not None, mode="scalar"):
                apart.leave_to_maps(β_direct * emission * (1 - chance), seen)
            emission *= chance
        L[seen] = dr.fma(β_direct, emission, L)
        if dr.hint(trail is not None, mode="scalar"):
            trail.emission(β_direct * emission, seen)
        if dr.hint(apart is not None, mode="scalar"):
            apart.emission(emission, β_direct, seen)
        on_surface = active & si.is_valid()
        active &= si.is_valid() & (depth < max_depth) & (dr.max(β) > 0)

        # --- Direct light by emitter sampling ---
        bsdf = si.bsdf(ray)
        if dr.hint(o.direct is not None, mode="scalar"):
            chances = o.direct.chances(si, *lit_sides(bsdf, si, ray))
        ds, light, wo, f, lit = _sample_light(scene, o, sampler, ctx, si, bsdf, β, chances, active)
        if dr.hint(o.use not in ("global", "none") and o.deep, mode="scalar"):
            # Over a walked part to a gathered one: the map has it.
            whole = f
            f = dr.select(scattered, gathered_part(bsdf, si, wo, o.roughness, lit), f)
            if dr.hint(apart is not None, mode="scalar"):
                apart.direct_light(light, f, whole, lit & scattered)
        L[lit] = dr.fma(f, light, L)
        if dr.hint(trail is not None, mode="scalar"):
            trail.direct_light(o.use, bsdf, si, wo, f * light, f, o.roughness, scattered, lit)

        # --- Leave a gather point ---
        is_receiver, lambertian, brdf, _, shines = read_receiver(
            bsdf, si, o.roughness, o.general, active, "here" if o.glossy else ""
        )
        is_receiver &= active
        weight = dr.select(lambertian, β * brdf, β)
        shines &= active & ~scattered
        here = (is_receiver | shines) & (depth + o.min_segments <= max_depth)
        finite = dr.all(dr.isfinite(weight))
        here &= dr.max(weight) != 0
        if dr.hint(o.follow_lobes, mode="scalar"):
            path.distance += dr.select(active, si.t, 0)
        if dr.hint(o.measure or o.surface, mode="scalar"):
            distance += dr.select(active, si.t, 0)
        if dr.hint(o.gathers, mode="scalar"):
            L[here & ~finite] = dr.nan  # counted and dropped later
            here &= chosen
            weight *= worth
            vertex = Vertex(
                lane, si, ray, weight, depth, path, lambertian, scattered, shines, distance
            )
            leave(vertex, here & finite)

        # --- Sample the BSDF ---
        bs, weight = bsdf.sample(ctx, si, sampler.next_1d(active), sampler.next_2d(active), active)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        if dr.hint(see is not None, mode="scalar"):
            see(lane, depth, si, bsdf, bs, active, scattered)
        g = _gathered_share(o, ctx, bsdf, si, bs, is_receiver, lambertian, delta)
        if dr.hint(trail is not None, mode="scalar"):
            trail.scatter(o.use, g, scattered)
            solid = active & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
            trail.see(si, β * weight, distance, is_receiver, solid)
        if dr.hint(o.follow_lobes, mode="scalar"):
            path = follow(path, bsdf, si, ray, bs, active & ~(dr.min(g) == 1))
        valid |= on_surface & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        ray = spawn_ray(si, si.to_world(bs.wo), reach)
        β, β_direct, scattered = _go_on(o, sampler, β * weight, g, scattered, active, apart)
        if dr.hint(chain is not None, mode="scalar"):
            shines &= ~scattered & ~delta & _on_one_side(si, bs.wo)
            # Not bs.pdf, which mask and blend have of the BSDF inside that they chose.
            pdf = shining_pdf(bsdf, si, bs.wo, shines)
            chain.leave(shines, pdf, delta, active)
        η *= bs.eta
        si_prev = mi.Interaction3f(si)
        pdf_prev = bs.pdf
        delta_prev = delta
        goes_on, may_end = dr.max(β) > 0, dr.max(β_direct) > 0
        if dr.hint(o.lamps is not None, mode="scalar"):
            may_end &= goes_on | o.lamps.may_meet(ray)
        active &= goes_on | may_end

        # --- Russian roulette, for paths that go on ---
        if dr.hint(o.deep or o.use != "global", mode="scalar"):
            survive = dr.minimum(dr.maximum(dr.max(β), dr.max(β_direct)) * η * η, 0.95)
            roulette = (depth >= rr_depth) & (dr.max(β) > 0)
            active &= ~roulette | (sampler.next_1d(active) < survive)
            scale = dr.select(roulette, dr.rcp(survive), 1)
            β *= scale
            β_direct *= scale
            if dr.hint(apart is not None, mode="scalar"):
                apart.throughput *= scale
        depth += 1
    kept = layers.Seen(L, trail.light, trail.surface) if trail is not None else L
    return (apart.parts(L) if apart is not None else kept), valid


def _sample_light(scene, o, sampler, ctx, si, bsdf, β, chances, active):
    """One emitter, with the BSDF towards it: (its sample, β times what arrives from it, weighted
    against BSDF sampling, local direction, BSDF's value with the cosine, lanes with such light)."""
    lit = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
    if o.direct is None:
        ds, light = scene.sample_emitter_direction(si, sampler.next_2d(), True, lit)
    else:
        ds, light = o.direct.sample(si, chances, sampler.next_2d(), lit)
    lit &= ds.pdf != 0
    wo = si.to_local(ds.d)
    f, pdf = bsdf.eval_pdf(ctx, si, wo, lit)
    if o.direct is not None:
        lit &= (dr.max(f) != 0) & (dr.max(light) != 0)
        lit &= ~scene.ray_test(si.spawn_ray_to(ds.p), lit)
    light *= β * dr.select(ds.delta, 1, _power_heuristic(ds.pdf, pdf))
    return ds, light, wo, f, lit


def _on_one_side(si, wo):
    """Does a photon that comes from there (local) count for what si.wi sees? (Not where shading and
    geometric normal disagree about the side.)"""
    n = dr.mulsign(mi.Vector3f(si.n), dr.dot(si.n, si.sh_frame.n))
    cos_s = mi.Frame3f.cos_theta(wo)
    reflects = mi.Frame3f.cos_theta(si.wi) * cos_s > 0
    return reflects & (dr.dot(si.to_world(wo), n) * cos_s > 0)


def _light_pdf(scene, direct, si, chances, ds, active):
    """Density with which ``_sample_light`` would have drawn what was met."""
    if direct is None:
        density = scene.pdf_emitter_direction(si, ds, active)
    else:
        density = direct.pdf(si, chances, ds, active)
    # A black environment map says 0/0.
    return dr.select(dr.isnan(density), 0, density)


def _gathered_share(o, ctx, bsdf, si, bs, is_receiver, lambertian, delta):
    """Share of the gathered part in the sampled direction, 0 to 1 in each channel."""
    g = dr.select(is_receiver, mi.Spectrum(1), mi.Spectrum(0))
    if not o.general:
        return g
    mixed = is_receiver & ~lambertian
    f_g = gathered_part(bsdf, si, bs.wo, o.roughness, mixed & ~delta)
    f = bsdf.eval(ctx, si, bs.wo, mixed & ~delta)
    share = dr.select(f > 0, dr.clip(f_g / f, 0, 1), 0)
    # rounding leaves nothing to walk on
    share = mi.Spectrum(dr.select(share > 1 - 1e-5, 1, share))
    return dr.select(mixed, dr.select(delta, 0, share), g)


def _go_on(o, sampler, β_both, g, scattered, active, apart):
    """Which part of the BSDF the path goes on with: (throughput of the path, and of emission at the
    next vertex, has it left a gathered part?).

    β_both  throughput with both parts; g: share of the gathered one.
    """
    if o.use == "none":
        # Not the same array: both are scaled in place.
        return mi.Spectrum(β_both), β_both, scattered
    if o.use == "global":
        return β_both * (1 - g), β_both, scattered
    # The path goes on with one of the parts, chosen by its share.
    chance = channel_mean(g)
    gathers = sampler.next_1d(active) < chance
    β = β_both * dr.select(gathers, g / chance, (1 - g) / (1 - chance))
    if o.use == "final_gather":
        β = dr.select(scattered, β_both * (1 - g), β)
    if apart is not None:
        apart.scatter(β_both * (1 - g), scattered)
    return β, dr.select(scattered, β_both * g, β_both), scattered | gathers


def _power_heuristic(a, b):
    """Veach's weight a²/(a² + b²) of a sample drawn with density a."""
    return dr.select(dr.isfinite(a), dr.rcp(1 + dr.square(b / a)), 1)


@dr.syntax
def _skip_emitters(scene, ray, si, active):
    """The first surface behind directly visible area lights (``hide_emitters``), as far away as it
    is from where the ray began, and the ray that finds it."""
    ray = mi.Ray3f(ray)
    passed = mi.Float(0)
    active = active & si.is_valid()
    active &= si.emitter(scene) != None  # noqa: E711
    while active:
        passed[active] += si.t
        ray[active] = si.spawn_ray(ray.d)
        si[active] = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        active &= si.emitter(scene) != None  # noqa: E711
    si.t += passed
    return si, ray
