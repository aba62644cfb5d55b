"""Camera paths up to their gather points.

A path is traced as Mitsuba's ``path`` does (emitter sampling and BSDF sampling, combined by the
power heuristic). At a receiver the gathered part of its BSDF (see ``receivers``) leaves a gather
point: what arrives there over two path segments or more is the photon map's. What is left for the
path depends on how the map is used:

global        the gathered part ends there, except for direct light; the walked part goes on.
caustic       the map holds caustics alone: light → walked parts → gathered part. The path goes on
              with both parts, and drops emission and direct light that reach a gathered part over
              one walked part or more, because the map has them.
final gather  "caustic" up to the first gathered part, "global" from there on.
none          there is no map: path tracing.
survey        "caustic", with what the other uses would have done told apart (see ``Parts``): for
              the pilot that chooses between them.

Each light path is counted exactly once in all of them.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..lobe_path import GlossyVertex, follow, no_lobe
from ..map.gather_points import GatherPoints, map_tree, take
from ..map.index import curve_order
from ..map.receivers import gathered_part, read_receiver
from ..map.spectra import channel_mean
from . import layers
from .rays import largest_coordinate, spawn_ray


@dataclass
class Thinning:
    """Which eye paths read the photon map: a share of them, with the weight 1/share.

    Samples of a pixel read much the same photons. Sample k of a pixel gathers where
    frac(k φ + ξ) < share, φ the golden ratio and ξ random for the pixel: each sample with the same
    chance, so that the mean is right, and of any number of consecutive samples that share within
    one or two, however they are spread over wavefronts and passes.

    share   of the paths, above 0 and at most 1, of each lane.
    seed    of the choice.
    pixel   of each lane; sample: its number among the pixel's samples.
    """

    share: Any
    seed: Any
    pixel: Any
    sample: Any

    @staticmethod
    def of(share, seed: int, pixel, sample) -> Thinning:
        """For one wavefront. share: of each pixel (mi.Float)."""
        share = dr.gather(mi.Float, share, pixel)
        return Thinning(share, dr.opaque(mi.UInt32, seed), pixel, sample)

    def chosen(self):
        """Does the path of each lane gather?"""
        start, _ = mi.sample_tea_32(self.pixel, self.seed, 8)  # with 4 rounds pixels are alike
        u = mi.Float((self.sample * 0x9E3779B9 + start) >> 8) * 2.0**-24
        return u < self.share


@dataclass
class Parts:
    """What the survey's eye paths see.

    radiance  as with use "caustic": W/m²/sr.
    later     the part of it that was found beyond a gathered part, which the global map has:
              radiance in the mean over channels.
    caustic   what was found over walked parts beyond a gathered part, which both maps have.
    """

    radiance: Any
    later: Any
    caustic: Any


@dataclass  # not frozen: Dr.Jit writes back whatever a loop mentions
class WalkOptions:
    """Decisions for one scene; what is off is not traced.

    use            see above.
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
    measure        keep the length of the path at gather points.
    thinning       which paths leave gather points; None: all do.
    light          split light by how it came (see ``layers``).
    surface        keep what is seen.
    """

    use: str
    max_depth: int
    rr_depth: int
    min_segments: int
    hide_emitters: bool
    gathers: bool
    follow_lobes: bool
    deep: bool
    general: bool
    roughness: float
    measure: bool = False
    thinning: Thinning | None = None
    light: bool = False
    surface: bool = False


def trace(scene, sampler, ray, options: WalkOptions, expected: int = 0, launch=None):
    """Trace camera paths: (radiance, valid, GatherPoints or None).

    radiance  W/m²/sr: emission, direct light, and whatever the map does not stand for. NaN where
              the throughput at a gather point is not finite. Parts where use is "survey",
              layers.Seen where somebody asks for layers.
    valid     did the ray meet anything but null surfaces and, if they are hidden, emitters?
              (alpha, as in ``path``)
    expected  gather points to make room for; with too few the same paths are traced again.
    launch    ``eye_paths``, or that function frozen.
    """
    if not options.gathers:
        launch = launch or eye_paths
        L, valid, _, _ = launch(scene, sampler.clone(), ray, options, None, None, None)
        dr.eval(L, valid)
        return L, valid, None
    # Without mixed receivers a path ends where it leaves its first gather point.
    single = options.use == "global" and not options.general
    capacity = dr.width(ray) if single else max(2 * dr.width(ray), expected + expected // 8)
    while True:
        rows, room = dr.opaque(mi.UInt32, 0), dr.opaque(mi.UInt32, capacity)
        points = map_tree(lambda v: dr.empty(type(v), capacity), _blank(options))  # noqa: B023
        L, valid, rows, points = (launch or eye_paths)(
            scene, sampler.clone(), ray, options, rows, points, room
        )
        dr.eval(L, valid, rows, points)
        found = int(rows[0])
        if found <= capacity:
            break
        capacity = found + found // 16
    if not found:
        return L, valid, None
    # Neighbours will look up the same photons.
    position = dr.gather(mi.Point3f, points.p, dr.arange(mi.UInt32, found))
    return L, valid, take(points, curve_order(position))


def eye_paths(scene, sampler, ray, options: WalkOptions, rows, points, room, see=None):
    """One wavefront of eye paths, gather points into their columns: (radiance, valid, rows used,
    columns). see: called as see(lane, depth, si, bsdf, bs, active, scattered) where paths scatter;
    scattered: have they left a gathered part before?"""

    def push(point, active):
        slot = dr.scatter_inc(rows, mi.UInt32(0), active)
        active = active & (slot < room)

        def put(column, value):
            dr.scatter(column, value, slot, active)
            return column

        map_tree(put, points, point)

    L, valid = _walk(scene, sampler, ray, options, push, see)
    return L, valid, rows, points


def _first_lobe(o: WalkOptions) -> GlossyVertex | None:
    return no_lobe() if o.follow_lobes else None


def _point(o: WalkOptions, lane, si, ray, weight, depth, path, lambertian, scattered, distance):
    """A gather point with the fields that the scene needs."""
    return GatherPoints(
        lane=lane,
        p=si.p,
        n=dr.mulsign(si.n, dr.dot(-ray.d, si.n)),
        weight=weight,
        depth=depth,
        path=path,
        origin=ray.o if o.general else None,
        d=ray.d if o.general else None,
        lambertian=lambertian if o.general else None,
        caustic={"final_gather": ~scattered, "survey": scattered}.get(o.use),
        distance=distance if o.measure else None,
        later=scattered if o.light and o.use != "global" else None,
    )


def _blank(o: WalkOptions) -> GatherPoints:
    si, ray = dr.zeros(mi.SurfaceInteraction3f), dr.zeros(mi.Ray3f)
    no = mi.Bool(False)
    zero = mi.UInt32(0)
    return _point(o, zero, si, ray, mi.Spectrum(0), zero, _first_lobe(o), no, no, mi.Float(0))


@dr.syntax
def _walk(scene, sampler, ray, options, push, see):
    ctx = mi.BSDFContext()
    o = options
    max_depth, rr_depth = dr.opaque(mi.UInt32, o.max_depth), dr.opaque(mi.UInt32, o.rr_depth)
    reach = dr.opaque(mi.Float, largest_coordinate(scene))

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
    pdf_prev = mi.Float(1)  # Density of the last BSDF sample
    delta_prev = mi.Bool(True)  # Was it a delta distribution (or the camera)?
    path = _first_lobe(o)
    distance = mi.Float(0)  # Length of the path
    trail = layers.begin(o.light, o.surface)  # What it keeps for layers, if anybody asks
    # What the survey tells apart: found beyond a gathered part; over walked parts beyond one, and
    # the throughput of emission there; had the path left a gathered part before its last vertex?
    survey = o.use == "survey"
    later: Any = None
    caustic: Any = None
    β_caustic: Any = None
    before: Any = None
    if dr.hint(survey, mode="scalar"):
        later, caustic = mi.Float(0), mi.Float(0)
        β_caustic, before = mi.Spectrum(0), mi.Bool(False)
    chosen, worth = mi.Bool(True), mi.Float(1)  # Does the path gather, and for how many others?
    if dr.hint(o.thinning is not None, mode="scalar"):
        chosen, worth = o.thinning.chosen(), dr.rcp(o.thinning.share)

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
        pdf_emitter = scene.pdf_emitter_direction(si_prev, ds, seen & ~delta_prev)
        mis = dr.select(delta_prev, 1, _power_heuristic(pdf_prev, pdf_emitter))
        emission = mis * ds.emitter.eval(si, seen)
        L[seen] = dr.fma(β_direct, emission, L)
        if dr.hint(trail is not None, mode="scalar"):
            trail.emission(β_direct * emission, seen)
        if dr.hint(survey, mode="scalar"):
            later[seen & before] += channel_mean(β_direct * emission)
            caustic[seen & before] += channel_mean(β_caustic * emission)
        on_surface = active & si.is_valid()
        active &= si.is_valid() & (depth < max_depth) & (dr.max(β) > 0)

        # --- Direct light by emitter sampling ---
        bsdf = si.bsdf(ray)
        sample_light = active & mi.has_flag(bsdf.flags(), mi.BSDFFlags.Smooth)
        ds, light = scene.sample_emitter_direction(si, sampler.next_2d(), True, sample_light)
        sample_light &= ds.pdf != 0
        wo = si.to_local(ds.d)
        f, pdf = bsdf.eval_pdf(ctx, si, wo, sample_light)
        light *= β * dr.select(ds.delta, 1, _power_heuristic(ds.pdf, pdf))
        if dr.hint(o.use not in ("global", "none") and o.deep, mode="scalar"):
            # Over a walked part to a gathered one: the map has it.
            whole = f
            f = dr.select(scattered, gathered_part(bsdf, si, wo, o.roughness, sample_light), f)
            if dr.hint(survey, mode="scalar"):
                later[sample_light & scattered] += channel_mean(f * light)
                caustic[sample_light & scattered] += channel_mean((whole - f) * light)
        L[sample_light] = dr.fma(f, light, L)
        if dr.hint(trail is not None, mode="scalar"):
            trail.direct_light(
                o.use, bsdf, si, wo, f * light, f, o.roughness, scattered, sample_light
            )

        # --- Leave a gather point ---
        is_receiver, lambertian, brdf = read_receiver(bsdf, si, o.roughness, o.general, active)
        is_receiver &= active
        weight = dr.select(lambertian, β * brdf, β)
        here = is_receiver & (depth + o.min_segments <= max_depth)
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
            point = _point(o, lane, si, ray, weight, depth, path, lambertian, scattered, distance)
            push(point, here & finite)

        # --- Sample the BSDF ---
        bs, weight = bsdf.sample(ctx, si, sampler.next_1d(active), sampler.next_2d(active), active)
        delta = mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta)
        if dr.hint(see is not None, mode="scalar"):
            see(lane, depth, si, bsdf, bs, active, scattered)
        # Share of the gathered part in the sampled direction
        g = dr.select(is_receiver, mi.Spectrum(1), mi.Spectrum(0))
        if dr.hint(o.general, mode="scalar"):
            mixed = is_receiver & ~lambertian
            f_g = gathered_part(bsdf, si, bs.wo, o.roughness, mixed & ~delta)
            f = bsdf.eval(ctx, si, bs.wo, mixed & ~delta)
            share = dr.select(f > 0, dr.clip(f_g / f, 0, 1), 0)
            # rounding leaves nothing to walk on
            share = mi.Spectrum(dr.select(share > 1 - 1e-5, 1, share))
            g = dr.select(mixed, dr.select(delta, 0, share), g)
        if dr.hint(trail is not None, mode="scalar"):
            trail.scatter(o.use, g, scattered)
            solid = active & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
            trail.see(si, β * weight, distance, is_receiver, solid)
        if dr.hint(o.follow_lobes, mode="scalar"):
            path = follow(path, bsdf, si, ray, bs, active & ~(dr.min(g) == 1))
        valid |= on_surface & ~mi.has_flag(bs.sampled_type, mi.BSDFFlags.Null)
        ray = spawn_ray(si, si.to_world(bs.wo), reach)
        β_direct = β * weight
        if dr.hint(o.use == "none", mode="scalar"):
            β = mi.Spectrum(β_direct)  # not the same array: both are scaled in place below
        elif dr.hint(o.use == "global", mode="scalar"):
            β = β_direct * (1 - g)
        else:
            # The path goes on with one of the parts, chosen by its share.
            chance = channel_mean(g)
            gathers = sampler.next_1d(active) < chance
            β = β_direct * dr.select(gathers, g / chance, (1 - g) / (1 - chance))
            if dr.hint(o.use == "final_gather", mode="scalar"):
                β = dr.select(scattered, β_direct * (1 - g), β)
            if dr.hint(survey, mode="scalar"):
                before = mi.Bool(scattered)  # not the same array, which changes in place
                β_caustic = dr.select(scattered, β_direct * (1 - g), 0)
            β_direct = dr.select(scattered, β_direct * g, β_direct)
            scattered |= gathers
        η *= bs.eta
        si_prev = mi.Interaction3f(si)
        pdf_prev = bs.pdf
        delta_prev = delta
        active &= (dr.max(β) > 0) | (dr.max(β_direct) > 0)

        # --- Russian roulette, for paths that go on ---
        if dr.hint(o.deep or o.use != "global", mode="scalar"):
            survive = dr.minimum(dr.maximum(dr.max(β), dr.max(β_direct)) * η * η, 0.95)
            roulette = (depth >= rr_depth) & (dr.max(β) > 0)
            active &= ~roulette | (sampler.next_1d(active) < survive)
            scale = dr.select(roulette, dr.rcp(survive), 1)
            β *= scale
            β_direct *= scale
            if dr.hint(survey, mode="scalar"):
                β_caustic *= scale
        depth += 1
    kept = layers.Seen(L, trail.light, trail.surface) if trail is not None else L
    return (Parts(L, later, caustic) if survey else kept), valid


def _power_heuristic(a, b):
    """Veach's weight a²/(a² + b²) of a sample drawn with density a."""
    return dr.select(dr.isfinite(a), dr.rcp(1 + dr.square(b / a)), 1)


@dr.syntax
def _skip_emitters(scene, ray, si, active):
    """The first surface behind directly visible area lights (``hide_emitters``), and the ray that
    finds it."""
    ray = mi.Ray3f(ray)
    active = active & si.is_valid()
    active &= si.emitter(scene) != None  # noqa: E711
    while active:
        ray[active] = si.spawn_ray(ray.d)
        si[active] = scene.ray_intersect(ray, active)
        active &= si.is_valid()
        active &= si.emitter(scene) != None  # noqa: E711
    return si, ray
