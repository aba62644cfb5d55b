"""The random check of emission: what light paths carry to where they first land, against emitter
sampling, for every class of emitter under random transforms.

Receivers are a plate, a cube and a ball at random places and, unless the light comes from outside,
a shell around everything. Their points p and the directions ω that light comes from define

    Φ_k = ∫ ∫ f_k(p, ω) L(p, ω) |cos| dω dA,   f = which receiver × (1, side of p, side of ω),

which is estimated as the mean of flux·f_k over light paths (``emission``), and as the mean of
f_k L |cos|/density over points on the receivers, with Mitsuba's emitter sampling, the one that eye
paths use, and, where rays can meet the light, with rays. Sides are those of random planes, so that
light at a wrong place or from a wrong direction shows as well as light of a wrong amount.

A try whose two estimates lie more than SUSPICION standard errors apart is made again with 16 times
as many samples of other seeds; it is a finding if they still do. A wrong factor shows four times
clearer then, chance (and the long tails of a mean over few samples) does not come twice: at 4
standard errors 500 tries of 12 quantities raise a false alarm with a probability of
6000 × (6.3e-5)² = 2.4e-5 if errors are normal, and 0.24 % if tails are ten times as heavy.

``python tests/random_light.py [TRIES [FIRST_SEED [KIND ...]]]`` prints the z-scores.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import aniso_pm  # noqa: F401 (registers the plugins)
import drjit as dr
import mitsuba as mi
import numpy as np
from aniso_pm.transport import emission
from aniso_pm.transport.focus import Focus

SUSPICION = 4.0
# Colours weigh differently, so that swapped ones show.
COLOURS = (1.0, 2.0, 4.0, 8.0)
SHELL = 8.0
ROOF = Path(__file__).with_name("roof.obj")
RECEIVERS = ("plate", "cube", "ball", "shell")


def T():
    return mi.ScalarTransform4f()


# --- Random numbers to scenes ---


def direction(rng):
    v = rng.normal(size=3)
    return v / np.linalg.norm(v)


def rotation(rng):
    return T().rotate(direction(rng).tolist(), rng.uniform(0, 360))


def scaling(rng, scale):
    """Factors along x, y, z: "rigid", "uniform" or "uneven", of either sign; positive ones:
    "round" (equal along x and y), "still" (uniform)."""
    factors = np.exp(rng.uniform(-0.7, 0.7, 3))
    if scale == "round":
        factors[1] = factors[0]
    if scale in ("uniform", "still"):
        factors[:] = factors[0]
    if scale == "rigid":
        factors[:] = 1
    signs = [1, 1, 1] if scale in ("round", "still") else rng.choice([-1, 1], 3)
    return T().scale((factors * signs).tolist())


def placed(rng, scale, size=1.0):
    """A random to_world, 2 to 4 units off the origin. Uneven scales are between two rotations, so
    that shapes are sheared, too."""
    inner = rotation(rng) if scale == "uneven" else T()
    outer = T() if scale == "still" else rotation(rng)
    place = direction(rng) * rng.uniform(2, 4)
    return T().translate(place.tolist()) @ outer @ scaling(rng, scale) @ inner.scale(size)


def aimed(rng, scale="rigid"):
    """The same, with z towards the receivers but for some 15 degrees."""
    place = direction(rng) * rng.uniform(3, 5)
    towards = T().look_at(place.tolist(), rng.normal(0, 0.5, 3).tolist(), direction(rng).tolist())
    factors = np.array(scaling(rng, scale).matrix).diagonal()[:3] * [1, 1, -1]
    factors[2] = abs(factors[2])  # z stays towards the receivers
    return towards @ T().scale(factors.tolist())


def texels(rng, height=4, width=4, channels=3):
    """Random ones, some of them ten times as bright as others."""
    values = rng.uniform(0.1, 1, (height, width, channels)) * rng.choice(
        [1, 10], (height, width, 1)
    )
    return mi.Bitmap(values.astype(np.float32))


def colour(rng):
    return {"type": "rgb", "value": rng.uniform(0.5, 2, 3).tolist()}


def texture(rng):
    return {"type": "bitmap", "bitmap": texels(rng), "filter_type": "nearest"}


def area(shape, scale, textured, inside=False):
    """A shape that emits, small and beside the receivers, or around them and inwards. Closed ones
    beside them emit outwards: of what should stay inside, Mitsuba's shadow rays let 1 % out."""

    def make(rng):
        radiance = texture(rng) if textured else colour(rng)
        emitter = {"type": "area", "radiance": radiance}
        to_world = placed(rng, scale, 4.0 if inside else 0.4)
        if inside:
            to_world = T().translate((-np.array(to_world.matrix)[:3, 3]).tolist()) @ to_world
        flip = bool(rng.integers(2)) and not textured
        if shape in ("cube", "sphere"):
            mirrored = np.linalg.det(np.array(to_world.matrix)[:3, :3]) < 0
            flip = inside != (mirrored and shape == "sphere")  # whose sides mirroring exchanges
        # Interpolated normals on so coarse a mesh make Mitsuba's estimates differ from each other.
        file = {"filename": str(ROOF), "face_normals": True} if shape == "obj" else {}
        light = (
            {"type": shape}
            | file
            | {"flip_normals": flip, "to_world": to_world, "emitter": emitter}
        )
        return {"light": light}

    return make


def several(rng):
    """Four at once; how often ``path`` asks each must not change what arrives."""
    lights = area("sphere", "uniform", False)(rng)
    lights["light"]["emitter"]["sampling_weight"] = rng.uniform(0.5, 2)
    lights["panel"] = area("rectangle", "uneven", True)(rng)["light"]
    lights["bulb"] = {"type": "point", "intensity": colour(rng), "to_world": placed(rng, "uneven")}
    lights["spot"] = spot(False)(rng)["light"] | {"sampling_weight": rng.uniform(0.5, 2)}
    return lights


def outside(rng):
    """From near and far at once."""
    return {
        "light": area("rectangle", "uneven", False)(rng)["light"],
        "sky": envmap(rng)["light"] | {"scale": 0.2},
        "sun": {"type": "directional", "to_world": aimed(rng), "irradiance": colour(rng)},
    }


def spot(textured):
    def make(rng):
        light = {"type": "spot", "intensity": colour(rng), "to_world": aimed(rng, "uniform")}
        light["cutoff_angle"] = rng.uniform(15, 60)
        light["beam_width"] = light["cutoff_angle"] * rng.uniform(0.3, 0.95)
        return {"light": light | ({"texture": texture(rng)} if textured else {})}

    return make


def projector(rng):
    light = {"type": "projector", "irradiance": texture(rng), "to_world": aimed(rng)}
    return {"light": light | {"fov": rng.uniform(30, 90)}}


def envmap(rng):
    turned = rotation(rng) @ scaling(rng, "rigid")
    return {"light": {"type": "envmap", "bitmap": texels(rng, 8, 16), "to_world": turned}}


def sunsky(rng):
    above = direction(rng)
    above[2] = abs(above[2]) + 0.1  # z is up where to_world turns nothing
    return {
        "light": {
            "type": "sunsky",
            "sun_direction": above.tolist(),
            "sun_scale": 0.05,  # as bright as the sky, so that both count
            "sun_aperture": 10.0,
            "to_world": rotation(rng) @ scaling(rng, "rigid"),
        }
    }


@dataclass(frozen=True)
class Kind:
    """lights(rng) → entries of the scene's dictionary; open: no shell, light comes from outside.
    parallel: light that emitter sampling cannot find, see ``from_surface``. met: rays meet all of
    it, see ``from_rays``."""

    lights: object
    open: bool = False
    parallel: bool = False
    met: bool = False


def kinds():
    """Name → Kind, every class of emitter that light paths can start at in this variant."""
    table = _kinds()
    if mi.is_spectral:
        del table["projector"], table["textured spot"]
    if mi.is_monochromatic:
        del table["sunsky"]  # Mitsuba has none
    return table


def _kinds():
    shapes = {"rectangle": "uneven", "disk": "uneven", "obj": "uneven", "cube": "uneven"}
    table = {}
    for textured in (False, True):
        # Refused: mirrored cylinders; textures on flipped shapes, where coordinates overlap, and on
        # spheres and cylinders that are turned.
        curved = ("still", "still") if textured else ("uniform", "round")
        scales = shapes | dict(zip(("sphere", "cylinder"), curved, strict=True))
        for shape, scale in scales.items():
            if textured and shape == "cube":
                continue
            name = f"{'textured ' if textured else ''}area, {shape}"
            table[name] = Kind(area(shape, scale, textured), met=True)
            if shape in ("cube", "sphere"):
                table[f"{name} around"] = Kind(
                    area(shape, scale, textured, True), open=True, met=True
                )
    parallel = {"type": "directionalarea", "radiance": {"type": "uniform", "value": 3.0}}
    return table | {
        "point": Kind(
            lambda rng: {
                "light": {
                    "type": "point",
                    "intensity": colour(rng),
                    "to_world": placed(rng, "uneven"),
                }
            }
        ),
        "spot": Kind(spot(False)),
        "textured spot": Kind(spot(True)),
        "projector": Kind(projector),
        "directional": Kind(
            lambda rng: {
                "light": {
                    "type": "directional",
                    "irradiance": colour(rng),
                    "to_world": aimed(rng),
                }
            },
            open=True,
        ),
        "directionalarea, rectangle": Kind(
            lambda rng: {
                "light": {"type": "rectangle", "to_world": aimed(rng, "uneven"), "e": parallel}
            },
            parallel=True,
        ),
        "directionalarea, cube": Kind(
            lambda rng: {
                "light": {"type": "cube", "to_world": placed(rng, "uneven", 0.4), "e": parallel}
            },
            parallel=True,
        ),
        "constant": Kind(
            lambda rng: {"light": {"type": "constant", "radiance": colour(rng)}}, True, met=True
        ),
        "envmap": Kind(envmap, open=True, met=True),
        "sunsky": Kind(sunsky, open=True, met=True),
        "several": Kind(several),
        "several, from near and far": Kind(outside, open=True),
    }


def scene(kind, rng):
    """A scene of random receivers under the light of a kind, as a dictionary, far off the origin
    in half of the cases."""
    black = {"type": "diffuse", "reflectance": {"type": "rgb", "value": 0.0}}
    plate = rotation(rng) @ T().translate([0, 0, 0.8]).scale([1.0, 0.7, 1])
    cube = rotation(rng) @ T().translate([0, 0.9, 0]) @ scaling(rng, "uneven").scale(0.25)
    parts = {
        "plate": {"type": "rectangle", "to_world": plate},
        "cube": {"type": "cube", "to_world": cube},
        "ball": {"type": "sphere", "to_world": T().translate([0.3, 0, -0.3]).scale(0.5)},
    }
    if not kind.open:
        parts["shell"] = {"type": "sphere", "to_world": T().scale(SHELL)}
    parts |= kind.lights(rng)
    home = T().translate((direction(rng) * rng.choice([0, 30])).tolist())
    for part in parts.values():
        if "to_world" in part:
            part["to_world"] = home @ part["to_world"]
        if part["type"] in ("rectangle", "disk", "cube", "sphere", "cylinder", "obj"):
            part["bsdf"] = black
    return {"type": "scene"} | parts


def load(parts):
    return mi.load_dict(parts, optimize=False)  # or Mitsuba merges receivers that share a BSDF


def become(changed, other):
    """Give a scene all parameters of another one of the same structure, as ``mi.traverse`` does."""
    parameters, wanted = mi.traverse(changed), mi.traverse(other)
    for name in parameters.keys():
        parameters[name] = wanted[name]
    parameters.update()


# --- The two estimates ---


@dataclass(frozen=True)
class Sides:
    """f_k: indicator functions of points and directions."""

    p: object
    d: object
    centre: object

    @staticmethod
    def random(rng, centre):
        return Sides(mi.Vector3f(direction(rng)), mi.Vector3f(direction(rng)), mi.Point3f(centre))

    def __call__(self, is_shell, p, d):
        """Six quantities; d points to where light comes from."""
        one, zero = mi.Float(1), mi.Float(0)
        for receiver in (is_shell, ~is_shell):
            yield dr.select(receiver, one, zero)
            yield dr.select(receiver & (dr.dot(self.p, p - self.centre) > 0), one, zero)
            yield dr.select(receiver & (dr.dot(self.d, d) > 0), one, zero)


def weighed(spectrum):
    return sum(spectrum[k] * COLOURS[k] for k in range(dr.size_v(mi.Spectrum)))


def summary(values):
    """[(mean, squared standard error)] of quantities. One more sample as large as the largest one
    of all counts in the error: few samples, or none, do not make a small one."""
    values = [dr.select(dr.isfinite(value), value, 0).numpy() for value in values]
    count, rare = len(values[0]), max(float(value.max()) for value in values)
    return np.array(
        [(v.mean(dtype=float), v.var(dtype=float) / count + (rare / count) ** 2) for v in values]
    )


def from_light_paths(scene, sides, count, seed, wavelengths, focus=None):
    """Flux that light paths carry to the receivers that they meet first. focus: where those from
    outside begin."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count)
    ray, flux, _ = (
        emission.prepare(scene)
        .focused(focus)
        .sample_ray(
            mi.Float(0),
            sampler.next_1d(),
            sampler.next_2d(),
            sampler.next_2d(),
            wavelengths=wavelengths,
        )
    )
    si = scene.ray_intersect(ray)
    lands, is_shell = mi.Bool(False), mi.Bool(False)
    for shape in receivers(scene):
        here = si.is_valid() & (si.shape == mi.ShapePtr(shape))
        lands |= here
        if shape.id() == "shell":
            is_shell |= here
    power = dr.select(lands, weighed(flux), 0)
    return summary(power * f for f in sides(is_shell, si.p, -ray.d))


def receivers(scene):
    return [shape for shape in scene.shapes() if shape.id() in RECEIVERS]


def _random_points(scene, count, seed, wavelengths):
    """(receiver, sampler, sampled positions, the same as interactions) of each receiver."""
    for number, shape in enumerate(receivers(scene)):
        sampler = mi.load_dict({"type": "independent"})
        sampler.seed(seed + number, count)
        point = shape.sample_position(mi.Float(0), sampler.next_2d())
        si = dr.zeros(mi.SurfaceInteraction3f, count)
        si.p, si.n = point.p, point.n
        if wavelengths is not None:
            si.wavelengths = wavelengths
        yield shape, sampler, point, si


def from_emitter_sampling(scene, sides, count, seed, wavelengths):
    """Flux that arrives at random points of the receivers, by Mitsuba's emitter sampling."""
    total = 0
    for shape, sampler, point, si in _random_points(scene, count, seed, wavelengths):
        ds, radiance = scene.sample_emitter_direction(si, sampler.next_2d())
        power = weighed(radiance) * dr.abs(dr.dot(ds.d, si.n)) / point.pdf
        is_shell = mi.Bool(shape.id() == "shell")
        total = total + summary(power * f for f in sides(is_shell, si.p, ds.d))
    return total


def from_rays(scene, sides, count, seed, wavelengths):
    """Flux that rays from random points of the receivers see: into the cone around the light's
    bounding sphere from outside of that, else into all directions."""
    lights = [shape for shape in scene.shapes() if shape.is_emitter()]
    total = 0
    for shape, sampler, point, si in _random_points(scene, count, seed, wavelengths):
        least, axis = mi.Float(-1), mi.Vector3f(0, 0, 1)
        if lights:
            ball = lights[0].bbox().bounding_sphere()
            axis = mi.Vector3f(ball.center) - si.p
            sine = dr.minimum(1.001 * ball.radius / dr.norm(axis), 1)
            least = dr.select(sine < 1, dr.sqrt(1 - dr.square(sine)), -1)
        u = sampler.next_2d()
        cosine = dr.lerp(1, least, u.x)
        s, c = dr.sincos(dr.two_pi * u.y)
        sine = dr.safe_sqrt(1 - dr.square(cosine))
        d = mi.Frame3f(dr.normalize(axis)).to_world(mi.Vector3f(sine * c, sine * s, cosine))
        hit = scene.ray_intersect(si.spawn_ray(d))
        radiance = hit.emitter(scene).eval(hit)
        power = weighed(radiance) * dr.abs(dr.dot(d, si.n)) / point.pdf
        power *= dr.two_pi * (1 - least)
        is_shell = mi.Bool(shape.id() == "shell")
        total = total + summary(power * f for f in sides(is_shell, si.p, d))
    return total


def from_surface(scene, sides, count, seed, wavelengths):
    """Light that leaves surfaces along their normals, W/m² as large as the radiance is given: what
    points on the surface see along their normals."""
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(seed, count)
    shape = next(shape for shape in scene.shapes() if shape.is_emitter())
    point = shape.sample_position(mi.Float(0), sampler.next_2d())
    si = dr.zeros(mi.SurfaceInteraction3f, count)
    si.p, si.n = point.p, point.n
    hit = scene.ray_intersect(si.spawn_ray(mi.Vector3f(point.n)))
    power = weighed(mi.Spectrum(3)) / point.pdf
    lands, is_shell = mi.Bool(False), mi.Bool(False)
    for shape in receivers(scene):
        here = hit.is_valid() & (hit.shape == mi.ShapePtr(shape))
        lands |= here
        if shape.id() == "shell":
            is_shell |= here
    power = dr.select(lands, power, 0)
    return summary(power * f for f in sides(is_shell, hit.p, -mi.Vector3f(point.n)))


# --- Tries ---


def difference(kind, scene, sides, count, seed, wavelengths, focus=None):
    """z-scores of the quantities; 0 where there is no light."""
    found = from_light_paths(scene, sides, count, seed, wavelengths, focus)
    scores, ratios = [], []
    others = [from_surface if kind.parallel else from_emitter_sampling]
    for number, estimate in enumerate(others + [from_rays] * kind.met):
        expected = estimate(scene, sides, count, seed + 1000 * (number + 1), wavelengths)
        # Single precision: a constant light's total scatters by its rounding alone.
        error = np.sqrt(found[:, 1] + expected[:, 1] + (1e-4 * expected[:, 0]) ** 2)
        apart = found[:, 0] - expected[:, 0]
        scores.append(np.where(error > 0, apart / np.maximum(error, 1e-30), 0))
        ratios.append(found[:, 0] / np.maximum(expected[:, 0], 1e-30))
    return np.concatenate(scores), np.concatenate(ratios)


@dataclass(frozen=True)
class Try:
    """z: of the quantities, against one estimate after the other. again: with 16 times as many
    samples, if any z was suspicious. ratio: light paths' estimate over the other one."""

    kind: str
    seed: int
    moved: bool
    z: np.ndarray
    again: np.ndarray | None
    ratio: np.ndarray

    @property
    def is_finding(self):
        return self.again is not None and np.abs(self.again).max() > SUSPICION

    def __str__(self):
        ratio = np.array2string(self.ratio, precision=4)
        start = f"{self.kind}{', moved' if self.moved else ''}, seed {self.seed}: z "
        scores = [np.array2string(z, precision=1) for z in (self.z, self.again) if z is not None]
        return start + ", again ".join(scores) + f", ratios {ratio}"


def attempt(name, seed, count, move=False):
    """One random scene of a kind; ``move``: reached from another one through ``mi.traverse``. In
    those that are not moved light from outside begins above the ball, mostly."""
    kind, rng = kinds()[name], np.random.default_rng([seed, *map(ord, name)])
    parts = scene(kind, rng)
    made = load(parts)
    if move:
        emission.prepare(made)  # Whatever is remembered of a scene is remembered wrong now
        parts = scene(kind, rng)
        become(made, load(parts))
    ball = np.array(parts["ball"]["to_world"].matrix)[:3, 3]
    sides = Sides.random(rng, ball)
    extent = np.linalg.norm(made.bbox().extents())
    focus = Focus(tuple(map(float, ball)), 0.05 * extent) if kind.open and not move else None
    wavelengths = None
    if mi.is_spectral:
        wavelengths = mi.sample_rgb_spectrum(mi.sample_shifted(mi.Float(rng.uniform())))[0]
    number = int(rng.integers(1 << 30))
    z, ratio = difference(kind, made, sides, count, number, wavelengths, focus)
    again = None
    if np.abs(z).max() > SUSPICION:
        again, ratio = difference(kind, made, sides, 16 * count, number + 1, wavelengths, focus)
    return Try(name, seed, move, z, again, ratio)


def run(names, tries, first_seed, count, tell=lambda done: None):
    """``tries`` of every kind, half of them moved by ``mi.traverse``."""
    done = []
    for name in names:
        for number in range(tries):
            done.append(attempt(name, first_seed + number, count, move=number % 2 == 1))
            tell(done[-1])
    return done


def main(tries="20", first_seed="0", *names):
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    for name in names or kinds():
        done = run([name], int(tries), int(first_seed), 1 << 17)
        z = np.array([t.z for t in done])
        bias = np.abs(z.sum(0) / len(z) ** 0.5).max()
        print(f"{name:28s} largest |z| {np.abs(z).max():.1f}, of the sum {bias:.1f}", flush=True)
        for t in done:
            if t.again is not None:
                print("   FOUND" if t.is_finding else "   no", t, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
