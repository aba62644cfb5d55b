"""Eye paths through a pixel, traced by the integrator's own code, and one gather point of them."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ...kernel import kernel_axes, project_to_plane
from ...map import density
from ...map.gather_points import take
from ...ndf import read_roughness
from ...rendering import film, footprint, gathering
from ...rendering.needs import describe, surfaces
from ...rendering.pilot import settle
from ...rendering.prepared import EYE, PROBE, Prepared, prepare, stream_seed
from ...rendering.schedule import (
    bandwidth,
    sample_count,
    shares,
    wavelength_sample,
    with_passes,
)
from ...rendering.settings import Settings
from .explanation import Explanation
from .record import Kernel, Lobe, Photons, Vertex

# Vertices of a path that are recorded.
_VERTICES = 32
# More than any path has.
_DEPTHS = 1 << 16
# Photons inside and outside the kernel that are kept for drawing, a random choice of more.
_DRAWN = 10_000
_PARAMETERS = ("kernel", "rule", "guard", "size", "epsilon", "max_aspect", "map", "final_gather")


def explain(
    scene,
    pixel: tuple[int, int],
    integrator=None,
    sensor=0,
    seed: int = 0,
    pass_index: int = 0,
    samples: int = 64,
    sample: int | None = None,
    spp: int = 0,
) -> Explanation:
    """Explain what the photon map gives to a pixel, and by which kernel.

    scene       Mitsuba scene.
    pixel       (x, y) from the top left of the film, inside its crop window.
    integrator  whose parameters are used; default: the scene's own, or the defaults of ``aniso_pm``
                where the scene has another one.
    sensor      sensor or its number.
    seed, pass_index  photon map: that of this pass of a rendering with this seed.
    samples     eye paths to trace through random points of the pixel.
    sample      number of the one that is shown, from 0; default: the one of median throughput
                among those that follow a lobe and find photons, if there are any.
    spp         as for rendering: of all passes, or of each where there is no limit to them; 0 takes
                those of the sensor's sampler.

    Raises ValueError for a pixel outside the film, a sample that is not there, and where the
    integrator refuses the scene.
    """
    if not isinstance(sensor, mi.Sensor):
        sensor = scene.sensors()[int(sensor)]
    _check_pixel(pixel, sensor.film())
    if sample is not None and not 0 <= sample < samples:
        raise ValueError(f"explain: sample {sample} is not one of 0 to {samples - 1}")
    integrator = integrator or scene.integrator()
    settings = with_passes(getattr(integrator, "settings", None) or Settings(), spp, sensor)
    hide_emitters = bool(getattr(integrator, "hide_emitters", False))

    # --- The photon map of that pass ---
    prepared = prepare(scene, settings, hide_emitters)
    spp = sample_count(settings, spp, sensor)
    pixels = film.pixel_count(sensor.film())
    each = shares(settings, spp, pixels).each
    settled = settle(prepared, sensor, seed, each)
    if settled.use == "none" and prepared.undecided:  # kernels are asked for
        prepared = prepared.with_(map="global")
        settled = settle(prepared, sensor, seed, each)
    radius0 = settled.radius
    # Photon by photon, so that those that are shown are those that are summed.
    prepared = settled.applied(prepared).with_(gather_tolerance=0.0)
    # Lobes are shown where rendering leaves them out, too (``kernel=auto``).
    left_out = not prepared.lobes_matter
    prepared = replace(prepared, lobes_matter=True)
    if not settings.initial_radius:
        width = settled.widths.reshape(film.sampled_size(sensor.film())[::-1])
        border = (width.shape[1] - sensor.film().crop_size().x) // 2
        row, column = (pixel[k] - sensor.film().crop_offset()[k] + border for k in (1, 0))
        seen = footprint.of(sensor, radius0, float(width[row, column]))
        prepared = replace(prepared, footprint=seen and seen.in_pass(pass_index))
    radius = bandwidth(radius0, settings.alpha, pass_index)
    colour = wavelength_sample(seed, pass_index)
    wavelengths = film.wavelengths(sensor, colour) if mi.is_spectral else None
    map_ = prepared.photon_map(seed, pass_index, 0, wavelengths)

    # --- Eye paths ---
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(mi.sample_tea_32(stream_seed(seed, EYE, pass_index), pixel[0])[1], samples)
    position = mi.Point2f(*pixel) + sampler.next_2d()
    ray, ray_weight = film.rays_through(sensor, sampler, position, colour)
    vertices = _Vertices.empty(samples)
    _, _, points = prepared.trace(sampler, ray, watch=lambda: vertices.see)

    found = Explanation(
        pixel=(int(pixel[0]), int(pixel[1])),
        pass_index=pass_index,
        seed=seed,
        radius=radius if map_.stored else None,
        photon_count=map_.emitted,
        parameters={name: getattr(settings, name) for name in _PARAMETERS},
        samples=samples,
        gather_points=0,
        following=0,
        pixel_radiance=(0.0,) * dr.size_v(mi.Spectrum),
        sample=sample,
        sentence="",
    )
    if points is None or not map_.stored:
        shown = sample or 0
        path = vertices.path(shown, scene, ())
        sentence = _why_nothing(prepared, map_, vertices, points)
        return replace(found, sentence=sentence, path=path, sample=shown if path else None)

    # --- All gather points, then one of them ---
    probe_seed = stream_seed(seed, PROBE, pass_index)
    size, lanes, depths = dr.width(points.lane), points.lane.numpy(), points.depth.numpy()
    # Numbered by path and vertex: a path may leave several gather points, in any order.
    number = lanes * _DEPTHS + depths
    position = {int(n): k for k, n in enumerate(number)}
    numbered = replace(points, lane=mi.UInt32(number))
    parts = prepared.gather(map_, dr.opaque(mi.Float, radius), probe_seed, numbered, wavelengths)
    radiance = np.zeros((size, dr.size_v(mi.Spectrum)))
    follows, inside, lost = np.zeros(size, bool), np.zeros(size, int), np.zeros(size, bool)
    for part in parts:
        at = np.array([position[int(n)] for n in part.lane.numpy()])
        weight = dr.gather(mi.Spectrum, ray_weight, part.lane // _DEPTHS)
        radiance[at] = np.array(part.radiance * weight).reshape(-1, len(at)).T
        follows[at], inside[at] = part.follows.numpy(), part.photons.numpy()
        lost[at] = part.lost.numpy()
    found = replace(
        found,
        gather_points=size,
        following=int(follows.sum()),
        pixel_radiance=tuple(map(float, radiance.sum(0) / samples)),
    )
    # Not by what the kernel finds: another rule is to be seen on the same path.
    throughput = np.array(points.weight).reshape(-1, size).mean(0)
    chosen = _choose(lanes, (follows, inside > 0), throughput, sample)
    if chosen is None and sample is not None:
        path = vertices.path(sample, scene, ())
        return replace(found, sentence=f"eye path {sample} reads no photon map", path=path)
    point = take(points, mi.UInt32(chosen))
    thickness = float(dr.mean(gathering.thickness(point, mi.Float(radius), prepared.footprint))[0])
    radius = float(dr.mean(gathering.bandwidth(point, mi.Float(radius), prepared.footprint))[0])
    found = replace(found, radius=radius)
    kernel, lobe, outlines = _kernel(prepared, point, radius, bool(lost[chosen]))
    lane = int(lanes[chosen])
    return replace(
        found,
        sample=lane,
        sentence=_sentence(kernel, left_out),
        path=vertices.path(lane, scene, depths[lanes == lane]),
        lobe=lobe,
        kernel=kernel,
        photons_inside=int(inside[chosen]),
        contribution=tuple(map(float, radiance[chosen])),
        photons=_photons(
            prepared,
            map_,
            take(numbered, mi.UInt32(chosen)),
            radius,
            thickness,
            probe_seed,
        ),
        outlines=outlines,
    )


def _check_pixel(pixel, film_):
    offset, size = film_.crop_offset(), film_.crop_size()
    (x0, y0), (w, h) = (tuple(map(int, v)) for v in (offset, size))
    if not (x0 <= pixel[0] < x0 + w and y0 <= pixel[1] < y0 + h):
        raise ValueError(
            f"pixel {pixel[0]},{pixel[1]} is outside the film; x may be {x0} to {x0 + w - 1}, "
            f"y {y0} to {y0 + h - 1} (from the top left)"
        )


def _choose(lanes, wanted, throughput, sample) -> int | None:
    """Number of the gather point to show."""
    of = np.arange(len(lanes)) if sample is None else np.flatnonzero(lanes == sample)
    if not len(of):
        return None
    for good in wanted:
        of = of[good[of]] if good[of].any() else of
    if sample is not None:
        return int(of[0])
    # By number where throughputs are equal: the order of the points is that of the threads.
    order = np.lexsort((lanes[of], throughput[of]))
    return int(of[order[len(of) // 2]])


# --- The path ------------------------------------------------------------------------------------


@dataclass
class _Vertices:
    """Columns with ``_VERTICES`` places for each eye path."""

    seen: Any
    p: Any
    n: Any
    shape: Any
    type: Any
    alpha_u: Any
    alpha_v: Any

    @staticmethod
    def empty(lanes: int) -> _Vertices:
        kinds = (mi.Bool, mi.Point3f, mi.Vector3f, mi.UInt32, mi.UInt32, mi.Float, mi.Float)
        return _Vertices(*(dr.zeros(kind, lanes * _VERTICES) for kind in kinds))

    def see(self, lane, depth, si, bsdf, bs, active, scattered):
        """Write down a vertex; called while eye paths are traced."""
        slot, active = lane * _VERTICES + depth - 1, active & (depth <= _VERTICES)
        alpha = read_roughness(bsdf, si, active)
        shape = dr.reinterpret_array(mi.UInt32, si.shape)
        values = (mi.Bool(True), si.p, mi.Vector3f(si.n), shape, bs.sampled_type, *alpha)
        for field, value in zip(fields(self), values, strict=True):
            dr.scatter(getattr(self, field.name), value, slot, active)

    def path(self, lane: int, scene, gathering) -> list[Vertex]:
        """Vertices of an eye path; gathering: depths at which it reads the photon map."""
        names = {}
        for name, shape in surfaces(scene):
            number = int(dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0])
            bsdf = shape.bsdf()
            kind = f" [{describe(bsdf)}]" if bsdf is not None else ""
            names[number] = name + kind
        found = []
        for k in range(lane * _VERTICES, (lane + 1) * _VERTICES):
            if not self.seen[k]:
                break
            depth = k - lane * _VERTICES + 1
            alpha = float(self.alpha_u[k]), float(self.alpha_v[k])
            found.append(
                Vertex(
                    depth,
                    names[int(self.shape[k])],
                    _plain(dr.gather(mi.Vector3f, mi.Vector3f(self.p), k)),
                    _plain(dr.gather(mi.Vector3f, self.n, k)),
                    _scattering(int(self.type[k])),
                    alpha if max(alpha) > 0 else None,
                    depth in gathering,
                )
            )
        return found

    def any(self) -> bool:
        return bool(dr.any(self.seen))


def _scattering(flags: int) -> str:
    names = (
        ("Null", "passes through"),
        ("DeltaReflection", "delta reflection"),
        ("DeltaTransmission", "delta transmission"),
        ("GlossyReflection", "glossy reflection"),
        ("GlossyTransmission", "glossy transmission"),
        ("DiffuseReflection", "diffuse reflection"),
        ("DiffuseTransmission", "diffuse transmission"),
    )
    for name, words in names:
        if flags & int(getattr(mi.BSDFFlags, name)):
            return words
    return "absorbs"


# --- The kernel ----------------------------------------------------------------------------------


def _kernel(prepared: Prepared, point, radius: float, lost: bool):
    """(Kernel, Lobe or None, outlines in the tangent frame) of one gather point."""
    options = prepared.kernel_options
    plane, follows, degenerate = density.kernels(point, mi.Float(radius), options)
    follows, degenerate = bool(follows[0]), bool(degenerate[0])
    path = None if point.path is None else point.path.lobe()
    lobe = None
    if path is not None and bool(path.valid[0]):
        lobe = _lobe(path)
    s, t = (np.array(_plain(v)) for v in (plane.s, plane.t))
    long, short = np.linalg.norm(s), np.linalg.norm(t)
    kernel = Kernel(
        follows_lobe=follows,
        why=_why_kernel(prepared, lobe, follows, degenerate),
        s=tuple(map(float, s)),
        t=tuple(map(float, t)),
        aspect=float(long / short),
        area=float(np.pi * long * short),
        clamped=follows and bool(plane.clamped[0]),
        capped=follows and bool(plane.capped[0]),
        off_surface=lost,
    )
    frame = np.stack([s / long, t / short])

    # --- Outlines where the weight is 1/e: the kernel, what it was made of, what it might be ---
    def outline(s, t):
        s, t = (np.array(_plain(v)) for v in (s, t))
        return _ellipse(frame @ s, frame @ t)

    outlines = {"kernel": outline(plane.s, plane.t)}
    disc = density.disc(point.n, mi.Float(radius))
    outlines["disc"] = outline(disc.s, disc.t)
    if follows and path is not None and lobe is not None:
        free = replace(options, guard=False)
        bare, _, _ = density.kernels(point, mi.Float(radius), free)
        outlines["unguarded"] = outline(bare.s, bare.t)
        la, lb = kernel_axes(path.lobe, path.r, 1.0, "lobe")
        outlines["footprint"] = outline(*project_to_plane(la, lb, path.r, point.n, path.distance))
        outlines["seen from p0"] = _in_lobe(lobe, s, t)
    return kernel, lobe, outlines


def _lobe(path) -> Lobe:
    x, y, z, r = (np.array(_plain(v)) for v in (path.lobe.x, path.lobe.y, path.lobe.z, path.r))
    lam, mu = float(path.lobe.lam[0]), float(path.lobe.mu[0])
    return Lobe(
        x=tuple(x),
        y=tuple(y),
        z=tuple(z),
        lam=lam,
        mu=mu,
        sigma=(_sigma(lam), _sigma(mu)),
        r=tuple(r),
        off=float(np.sqrt(2 * lam * (r @ x) ** 2 + 2 * mu * (r @ y) ** 2)),
        distance=float(path.distance[0]),
    )


def _sigma(bandwidth: float) -> float:
    """Standard deviation, degrees, of exp(−bandwidth · angle²)."""
    return float(np.degrees((2 * bandwidth) ** -0.5))


def _ellipse(s, t):
    """Points s cos φ + t sin φ."""
    phi = np.linspace(0, 2 * np.pi, 181)[:, None]
    return np.cos(phi) * s + np.sin(phi) * t


def _in_lobe(lobe: Lobe, s, t):
    """The kernel's outline as directions from where its lobe is (p0, or its mirror image), in the
    lobe's coordinates (v·x, v·y)."""
    v = np.array(lobe.r) * lobe.distance + _ellipse(s, t)
    v /= np.linalg.norm(v, axis=1, keepdims=True)
    return np.stack([v @ np.array(lobe.x), v @ np.array(lobe.y)], axis=1)


def _photons(
    prepared: Prepared, map_, point, radius: float, thickness: float, seed: int
) -> Photons:
    """Photons in a window around the kernel. seed: of density estimation."""
    plane, _, _ = density.kernels(point, mi.Float(radius), prepared.kernel_options)
    options, thick = prepared.gather_options, mi.Float(thickness)
    point = gathering.walled(prepared.scene, point, plane, thick, seed, options)
    limit = prepared.gather_depth
    counted = density.photons_inside(map_, point, plane, mi.Float(thickness), limit).numpy()
    at = dr.gather(mi.Vector4f, map_.index.points, dr.arange(mi.UInt32, map_.stored))
    offset = mi.Vector3f(at.x, at.y, at.z) - mi.Vector3f(point.p)
    s, t, n = (np.array(_plain(v)) for v in (plane.s, plane.t, point.n))
    d = np.array(offset).T.astype(np.float64)
    long, short = np.linalg.norm(s), np.linalg.norm(t)
    xy = np.stack([d @ s / long, d @ t / short], axis=1)
    word = dr.reinterpret_array(mi.UInt32, at.w)
    facing = density.same_surface(point, word, offset).numpy()
    facing &= np.abs(d @ n) <= density.SLAB * thickness

    reach = 1.15 * density.CUT2**0.5 * long
    near = np.flatnonzero((np.abs(xy) <= reach).all(1) & (np.abs(d @ n) <= reach))
    random = np.random.default_rng(0)
    groups = [near[counted[near] == kind] for kind in (True, False)]
    groups = [g if len(g) <= _DRAWN else random.choice(g, _DRAWN, replace=False) for g in groups]
    near = np.sort(np.concatenate(groups))
    rho2 = (xy[near, 0] / long) ** 2 + (xy[near, 1] / short) ** 2
    weight = np.where(counted[near], np.exp(-rho2), 0)
    return Photons(xy[near], weight, counted[near], facing[near], map_.stored)


# --- Words ---------------------------------------------------------------------------------------


def _why_nothing(prepared: Prepared, map_, vertices: _Vertices, points) -> str:
    if not vertices.any():
        return "sees no surface that scatters light (emitters, the background, or nothing)"
    if not prepared.needs_map:
        return "path traced alone, this scene needs no photon map (see aniso-pm inspect)"
    if points is None:
        return (
            "no eye path reads the photon map here: all end on emitters, leave the scene, or stay "
            "on surfaces that do not gather (see gather_roughness and max_depth)"
        )
    return f"no photon was stored, of {map_.emitted:,} light paths: the map gives nothing here"


def _why_kernel(prepared: Prepared, lobe, follows: bool, degenerate: bool) -> str:
    s = prepared.settings
    if follows:
        guard = "" if s.guard else ", no guard"
        size = "" if s.size == "bandwidth" else f", literal size for epsilon={s.epsilon:g}"
        return f"ellipse that follows the lobe (rule {s.rule}{guard}{size})"
    if s.kernel == "isotropic":
        return "disc (kernel=isotropic)"
    if degenerate:
        return "disc (the path left outside its lobe, there is no shape to follow)"
    if not prepared.follow_lobes:
        return "disc (the scene has no anisotropic surface whose roughness can be read)"
    return "disc (no anisotropic reflection lobe arrives here)"


def _sentence(kernel: Kernel, left_out: bool) -> str:
    if kernel.follows_lobe:
        disc = ", instead of which kernel=auto takes the disc (see aniso-pm inspect)"
        words = f"kernel of aspect {kernel.aspect:.2g} along an anisotropic lobe"
        return words + disc * left_out
    return "isotropic kernel: " + kernel.why.removeprefix("disc ").strip("()")


def _plain(vector) -> tuple[float, ...]:
    return tuple(float(v) for v in np.array(mi.Vector3f(vector)).reshape(3, -1)[:, 0])
