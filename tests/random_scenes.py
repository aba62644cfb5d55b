"""Random shapes and cameras: indirect light of this integrator against ``path``.

A shape of each class stands on a floor under a lamp, with a random, mirrored and (where Mitsuba
allows it) uneven ``to_world``, ``flip_normals`` and ``face_normals`` at random, one- or two-sided;
or the shape stands still, and a camera of each class sees it over a random ``to_world``. What is
compared is the mean over the picture of all light over more than one bounce.

As in ``random_light``, a difference of more than 4 standard errors is a suspicion, which is looked
at again with more samples and other seeds. Errors come from 6 seeds: 4 of them (t of 10 degrees of
freedom) happen by chance in 0.25 % of the tries and twice in 6e-6, in 500 tries in 0.3 %. Half a
percent is added for the kernels' blur at a radius of 1/200 of the scene.

``python tests/random_scenes.py [TRIES [FIRST_SEED [KIND ...]]]`` prints ratios.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import aniso_pm  # noqa: F401 (registers the plugins)
import mitsuba as mi
import numpy as np
from energy import indirect
from random_light import ROOF, SUSPICION, T, direction, rotation, scaling

SEEDS = 6
BLUR = 0.005
CURVE = Path(__file__).with_name("curve.txt")
OURS = {"type": "aniso_pm", "map": "global", "initial_radius": 0.01, "photon_count": 200_000}


def diffuse(value):
    return {"type": "diffuse", "reflectance": {"type": "rgb", "value": value}}


# Shape → the scales that Mitsuba allows
SHAPES = {
    "rectangle": "uneven",
    "disk": "uneven",
    "cube": "uneven",
    "obj": "uneven",
    "sphere": "uniform",
    "cylinder": "mirrored round",
    "bsplinecurve": "uniform",
    "linearcurve": "uniform",
}
FLAT = ("perspective", "thinlens", "orthographic")
CAMERAS = (*FLAT, "radiancemeter", "distant")


def shape(kind, rng):
    scale = SHAPES[kind]
    sizes = scaling(rng, scale.removeprefix("mirrored "))
    if scale.startswith("mirrored"):
        sizes = sizes @ T().scale(rng.choice([-1, 1], 3).tolist())
    inner = rotation(rng) if scale == "uneven" else T()
    to_world = T().translate([0, 0.9, 0]) @ rotation(rng) @ sizes @ inner.scale(0.4)
    more = {}
    if kind in ("rectangle", "disk", "cube", "obj", "sphere", "cylinder"):
        more["flip_normals"] = bool(rng.integers(2))
    if kind == "obj":
        more |= {"filename": str(ROOF), "face_normals": bool(rng.integers(2))}
    if "curve" in kind:
        more |= {"filename": str(CURVE)}
    bsdf = diffuse([0.7, 0.5, 0.4])
    if rng.integers(2):
        bsdf = {"type": "twosided", "b": bsdf}
    return {"type": kind, "to_world": to_world, "bsdf": bsdf} | more


def camera(kind, rng):
    """Mirrored in half of the cases, and scaled where the class takes it."""
    film = {
        "type": "hdrfilm",
        "width": 16,
        "height": 16,
        "rfilter": {"type": "box"},
        "pixel_format": "rgb",
        "component_format": "float32",
    }
    towards = direction(rng) * [1, 0.5, 1] + [0, 0.6, 0]
    place = (3.5 * towards / np.linalg.norm(towards)).tolist()
    to_world = T().look_at(place, [0, 0.5, 0], direction(rng).tolist())
    mirrored = T().scale([float(rng.choice([-1, 1])), 1, 1])
    more = {}
    if kind in ("perspective", "thinlens"):
        more = {"fov": 45}
    if kind == "thinlens":
        more |= {"aperture_radius": rng.uniform(0.05, 0.3), "focus_distance": 3.0}
    if kind == "orthographic":
        to_world = to_world @ T().scale(np.exp(rng.uniform(-0.5, 0.5, 2)).tolist() + [1])
    if kind in ("radiancemeter", "distant"):
        film |= {"width": 1, "height": 1}
    if kind == "distant":
        return {
            "type": kind,
            "direction": (-np.array(place)).tolist(),
            "target": [0, 0.6, 0],
            "film": film,
        }
    return {"type": kind, "to_world": to_world @ mirrored, "film": film} | more


def scene(kind, rng):
    still = np.random.default_rng(1)
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": camera(kind, rng) if kind in CAMERAS else camera("perspective", still),
            "floor": {
                "type": "rectangle",
                "to_world": T().rotate([1, 0, 0], -90).scale(2),
                "bsdf": {"type": "twosided", "b": diffuse([0.6, 0.6, 0.7])},
            },
            "shape": shape("cube" if kind in CAMERAS else kind, rng),
            "lamp": {
                "type": "rectangle",
                "to_world": T().translate([0.5, 2.5, 0.5]).rotate([1, 0, 0], 90).scale(0.5),
                "bsdf": diffuse(0.0),
                "emitter": {"type": "area", "radiance": {"type": "rgb", "value": [9, 8, 7]}},
            },
        },
        optimize=False,
    )


@dataclass(frozen=True)
class Try:
    """ratio: of our energy to that of path. error: of the ratio, blur included."""

    kind: str
    seed: int
    ratio: float
    error: float
    again: tuple | None

    @property
    def is_finding(self):
        return self.again is not None and abs(self.again[0] - 1) > SUSPICION * self.again[1]

    def __str__(self):
        text = f"{self.kind}, seed {self.seed}: {self.ratio:.4f} ± {self.error:.4f}"
        return text + (f", again {self.again[0]:.4f} ± {self.again[1]:.4f}" if self.again else "")


def compare(made, spp, first):
    """(ratio, its error) of a scene."""

    def energy(integrator, spp):
        return np.array(
            [indirect(made, integrator, -1, spp, first + seed).mean() for seed in range(SEEDS)]
        )

    ours, theirs = energy(OURS, spp), energy({"type": "path"}, 4 * spp)
    if theirs.mean() < 1e-4:  # the camera sees nothing that is lit twice
        return 1.0, 1.0
    relative = [x.std(ddof=1) / SEEDS**0.5 / x.mean() for x in (ours, theirs)]
    return ours.mean() / theirs.mean(), float(np.hypot(np.hypot(*relative), BLUR))


def attempt(kind, seed, spp):
    rng = np.random.default_rng([seed, *map(ord, kind)])
    made = scene(kind, rng)
    # A film of one pixel has fewer samples.
    spp *= 1 if kind in FLAT or kind in SHAPES else 64
    ratio, error = compare(made, spp, 100 * seed)
    again = None
    if abs(ratio - 1) > SUSPICION * error:
        again = compare(made, 8 * spp, 100 * seed + 50)
    return Try(kind, seed, ratio, error, again)


def run(kinds, tries, first_seed, spp, tell=lambda done: None):
    done = []
    for kind in kinds:
        for number in range(tries):
            done.append(attempt(kind, first_seed + number, spp))
            tell(done[-1])
    return done


def main(tries="4", first_seed="0", *kinds):
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    run(
        kinds or (*SHAPES, *CAMERAS),
        int(tries),
        int(first_seed),
        128,
        lambda t: print(t, flush=True),
    )


if __name__ == "__main__":
    main(*sys.argv[1:])
