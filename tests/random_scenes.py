"""Random shapes and cameras: indirect light of this integrator against ``path``.

A shape of each class hangs in a closed room, with a random, mirrored and (where Mitsuba allows it)
uneven ``to_world``, ``flip_normals`` and ``face_normals`` at random, one- or two-sided; or a camera
of each class sees a room over a random ``to_world``. What is compared is the mean of all light over
more than one bounce, over the picture and over the shape.

As in ``random_light``, a difference of more than 4 standard errors is a suspicion, which is looked
at again with more samples and other seeds. Errors come from 6 seeds: 4 of them (t of 10 degrees of
freedom) happen by chance in 0.25 % of the cases and twice in 6e-6, in 500 tries in 0.6 %. Half a
percent is added for the kernels' blur at a radius of 1/100 of the room.

``python tests/random_scenes.py [TRIES [FIRST_SEED [KIND ...]]]`` prints ratios.
"""

import sys
from dataclasses import dataclass
from pathlib import Path

import aniso_pm  # noqa: F401 (registers the plugins)
import mitsuba as mi
import numpy as np
from energy import indirect, regions
from random_light import ROOF, SUSPICION, T, direction, rotation, scaling
from rooms import room

SEEDS = 6
BLUR = 0.005
CURVE = Path(__file__).with_name("curve.txt")
OURS = {
    "type": "aniso_pm",
    "map": "global",
    "initial_radius": 0.02,
    "alpha": 1.0,
    "photon_count": 200_000,
}


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
    to_world = T().translate([0, -0.2, -0.2]) @ rotation(rng) @ sizes @ inner.scale(0.3)
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
    place = (direction(rng) * rng.uniform(0.5, 0.9)).tolist()
    to_world = T().look_at(place, rng.uniform(-0.2, 0.2, 3).tolist(), direction(rng).tolist())
    mirrored = T().scale([float(rng.choice([-1, 1])), 1, 1])
    more = {}
    if kind in ("perspective", "thinlens"):
        more = {"fov": rng.uniform(40, 90)}
    if kind == "thinlens":
        more |= {"aperture_radius": rng.uniform(0.02, 0.1), "focus_distance": 1.0}
    if kind == "orthographic":
        to_world = to_world @ T().scale(np.exp(rng.uniform(-0.5, 0.5, 2)).tolist() + [1])
    if kind in ("radiancemeter", "distant"):
        film |= {"width": 1, "height": 1}
    if kind == "distant":
        down = [rng.uniform(-0.3, 0.3), -1, rng.uniform(-0.3, 0.3)]
        return {"type": kind, "direction": down, "target": [0.5, -1, 0.5], "film": film}
    return {"type": kind, "to_world": to_world @ mirrored, "film": film} | more


def scene(kind, rng):
    parts = room(size=24)
    if kind in CAMERAS:
        parts["sensor"] = camera(kind, rng)
        if kind == "distant":
            del parts["ceiling"]  # or it sees that from behind
    else:
        parts["shape"] = shape(kind, rng)
    return mi.load_dict(parts, optimize=False)


@dataclass(frozen=True)
class Try:
    """{region: (ratio of our energy to that of path, its error, blur included)}, and again with
    more samples if anything was suspicious."""

    kind: str
    seed: int
    found: dict
    again: dict | None

    @property
    def is_finding(self):
        return self.again is not None and suspicious(self.again)

    def __str__(self):
        def told(found):
            return ", ".join(f"{name} {r:.4f} ± {e:.4f}" for name, (r, e) in found.items())

        text = f"{self.kind}, seed {self.seed}: {told(self.found)}"
        return text + (f"; again {told(self.again)}" if self.again else "")


def suspicious(found):
    return any(abs(ratio - 1) > SUSPICION * error for ratio, error in found.values())


def compare(made, spp, first):
    def pictures(integrator, spp):
        return [indirect(made, integrator, -1, spp, first + seed) for seed in range(SEEDS)]

    ours, theirs = pictures(OURS, spp), pictures({"type": "path"}, 4 * spp)
    if ours[0].size > 3:
        masks = {k: m for k, m in regions(made).items() if k in ("image", "shape")}
    else:
        masks = {"image": ...}
    return ratios(ours, theirs, masks, BLUR, 1e-4)


def ratios(ours, theirs, masks, blur, black):
    """Region → (mean of our pictures over that of theirs, its error with the blur of kernels) where
    theirs is not black: the side of a one-sided surface, for example."""
    found = {}
    for name, mask in masks.items():
        means = [np.array([image[mask].mean() for image in side]) for side in (ours, theirs)]
        if means[1].mean() < black:
            continue
        relative = [x.std(ddof=1) / SEEDS**0.5 / means[1].mean() for x in means]
        error = float(np.hypot(np.hypot(*relative), blur))
        found[name] = (float(means[0].mean() / means[1].mean()), error)
    return found


def attempt(kind, seed, spp):
    rng = np.random.default_rng([seed, *map(ord, kind)])
    made = scene(kind, rng)
    # A film of one pixel has fewer samples.
    spp *= 64 if kind in ("radiancemeter", "distant") else 1
    found = compare(made, spp, 100 * seed)
    again = compare(made, 8 * spp, 100 * seed + 50) if suspicious(found) else None
    return Try(kind, seed, found, again)


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
    kinds = kinds or (*SHAPES, *CAMERAS)
    run(kinds, int(tries), int(first_seed), 32, lambda t: print(t, flush=True))


if __name__ == "__main__":
    main(*sys.argv[1:])
