"""Random trees of BSDFs with random textures, as installed: all light against ``path``.

A shape of random class and ``to_world`` hangs in a closed room; in a third of the cases the floor
has a random BSDF as well. Map and final gathering are left as they are or set at random, nothing
else is: radius, shares, light paths are those of the pilot. What is compared is the mean over the
picture, the shape and the floor, as in ``random_scenes``, whose method and false alarms these are;
kernels blur by less than a third of a percent here.

Glass under bump and normal maps is left out: where these tilt it by more than 20 degrees Mitsuba's
BSDFs are not reciprocal.

``python tests/random_materials.py [TRIES [FIRST_SEED]]`` prints ratios.
"""

import sys

import aniso_pm  # noqa: F401 (registers the plugins)
import mitsuba as mi
import numpy as np
from energy import regions
from random_light import T
from random_scenes import SEEDS, Try, ratios, shape, suspicious
from rooms import room

BLUR = 0.003
SHAPES = ("rectangle", "cube", "sphere", "disk", "cylinder", "obj")
OPAQUE = ("diffuse", "metal", "brushed", "asg", "mirror", "plastic", "rough plastic", "principled")
GLASS = ("glass", "pane", "frosted", "brushed glass", "clear principled", "leaf", "null")
WRAPPERS = ("twosided", "mask", "blendbsdf", "bumpmap", "normalmap")


def chance(rng, p):
    return bool(rng.random() < p)


def uv(rng):
    return T().scale([*np.exp(rng.uniform(0, 3, 2)).tolist(), 1])


def bitmap(rng, channels, low, high):
    size = (*rng.integers(2, 9, 2), channels)
    return {
        "type": "bitmap",
        "bitmap": mi.Bitmap(rng.uniform(low, high, size).astype(np.float32)),
        "raw": True,
        "filter_type": str(rng.choice(["nearest", "bilinear"])),
        "to_uv": uv(rng),
    }


def chequers(rng, first, second):
    return {"type": "checkerboard", "color0": first, "color1": second, "to_uv": uv(rng)}


def colour(rng):
    def plain():
        return {"type": "rgb", "value": rng.uniform(0.05, 0.95, 3).tolist()}

    kinds = (plain, lambda: chequers(rng, plain(), plain()), lambda: bitmap(rng, 3, 0.05, 0.95))
    return kinds[rng.integers(3)]()


def scalar(rng, low=0.0, high=1.0):
    def plain():
        return float(rng.uniform(low, high))

    kinds = (plain, lambda: chequers(rng, plain(), plain()), lambda: bitmap(rng, 1, low, high))
    return kinds[rng.choice(3, p=[0.5, 0.25, 0.25])]()


def leaf(rng, kinds):
    kind = str(rng.choice(kinds))
    distribution = {"distribution": str(rng.choice(["beckmann", "ggx"]))}

    def grain():
        return {"alpha_u": scalar(rng, 0.03, 0.8), "alpha_v": scalar(rng, 0.03, 0.8)}

    def alpha():
        return {"alpha": scalar(rng, 0.03, 0.8)}

    def principled():
        values = {"type": "principled", "base_color": colour(rng)}
        values |= {"roughness": scalar(rng, 0.1), "metallic": scalar(rng)}
        values |= {"anisotropic": scalar(rng)}
        if chance(rng, 0.5):
            values |= {"clearcoat": scalar(rng), "clearcoat_gloss": scalar(rng)}
        for name in ("sheen", "spec_tint", "flatness"):
            values |= {name: float(rng.random())} if chance(rng, 0.5) else {}
        return values

    def thin():
        values = {"type": "principledthin", "base_color": colour(rng)}
        values |= {"roughness": scalar(rng, 0.1), "spec_trans": float(rng.random())}
        return values | {"diff_trans": float(rng.uniform(0, 2))}

    made = {
        "diffuse": lambda: {"type": "diffuse", "reflectance": colour(rng)},
        "metal": lambda: {"type": "roughconductor"} | alpha() | distribution,
        "brushed": lambda: {"type": "roughconductor", "material": "Al"} | grain() | distribution,
        "asg": lambda: {"type": "asgconductor", "material": "Cu"} | grain(),
        "mirror": lambda: {"type": "conductor", "material": "Ag"},
        "plastic": lambda: {"type": "plastic", "diffuse_reflectance": colour(rng)},
        "rough plastic": lambda: (
            {"type": "roughplastic", "diffuse_reflectance": colour(rng)}
            | {"alpha": float(rng.uniform(0.03, 0.8))}
            | distribution
        ),
        "principled": principled,
        "glass": lambda: {"type": "dielectric", "int_ior": float(rng.uniform(1.05, 2))},
        "pane": lambda: {"type": "thindielectric"},
        "frosted": lambda: {"type": "roughdielectric"} | alpha() | distribution,
        "brushed glass": lambda: {"type": "roughdielectric"} | grain() | distribution,
        "clear principled": lambda: principled() | {"spec_trans": scalar(rng)},
        "leaf": thin,
        "null": lambda: {"type": "null"},
    }
    return made[kind]()


def tree(rng, depth=2, opaque=False):
    """A BSDF with wrappers up to so many levels deep."""
    kinds = OPAQUE if opaque else OPAQUE + GLASS
    wrapper = str(rng.choice(WRAPPERS)) if depth and chance(rng, 0.6) else None
    if wrapper == "twosided":
        back = {"b": tree(rng, depth - 1, True)} if chance(rng, 0.3) else {}
        return {"type": "twosided", "a": tree(rng, depth - 1, True)} | back
    if wrapper == "mask" and not opaque:
        return {"type": "mask", "opacity": scalar(rng), "a": tree(rng, depth - 1)}
    if wrapper == "blendbsdf":
        nested = {name: tree(rng, depth - 1, opaque) for name in ("a", "b")}
        return {"type": "blendbsdf", "weight": scalar(rng)} | nested
    if wrapper == "bumpmap":
        height = {"arbitrary": bitmap(rng, 1, 0, 1), "scale": float(rng.uniform(0, 0.02))}
        return {"type": "bumpmap", "a": leaf(rng, OPAQUE)} | height
    if wrapper == "normalmap":
        normals = rng.uniform(0.4, 0.6, (4, 4, 3)).astype(np.float32)
        normals[..., 2] = 1
        map_ = {"type": "bitmap", "bitmap": mi.Bitmap(normals), "raw": True}
        return {"type": "normalmap", "normalmap": map_, "a": leaf(rng, OPAQUE)}
    return leaf(rng, kinds)


def scene(rng):
    """(scene, integrator) as dictionaries."""
    parts = room(size=32)
    parts["shape"] = shape(str(rng.choice(SHAPES)), rng) | {"bsdf": tree(rng)}
    if chance(rng, 1 / 3):
        parts["floor"]["bsdf"] = tree(rng, 2, opaque=True)
    ours = {"type": "aniso_pm", "map": str(rng.choice(["auto", "global", "caustic"]))}
    if ours["map"] == "global":
        ours["final_gather"] = chance(rng, 0.3)
    return parts, ours


def compare(made, integrator, spp, first):
    def pictures(integrator, spp):
        plugin = mi.load_dict(integrator)
        seeds = range(first, first + SEEDS)
        return [np.array(mi.render(made, integrator=plugin, spp=spp, seed=s)) for s in seeds]

    ours, theirs = pictures(integrator, spp), pictures({"type": "path"}, 8 * spp)
    masks = {k: m for k, m in regions(made).items() if k in ("image", "shape", "floor")}
    return ratios(ours, theirs, masks, BLUR, 1e-3)


def attempt(seed, spp):
    parts, integrator = scene(np.random.default_rng([seed, 7]))
    made = mi.load_dict(parts, optimize=False)
    found = compare(made, integrator, spp, 100 * seed)
    again = compare(made, integrator, 8 * spp, 100 * seed + 50) if suspicious(found) else None
    said = f"{integrator}, {parts['shape']['type']} of {parts['shape']['bsdf']['type']}"
    return Try(said, seed, found, again)


def run(tries, first_seed, spp, tell=lambda done: None):
    done = []
    for seed in range(first_seed, first_seed + tries):
        done.append(attempt(seed, spp))
        tell(done[-1])
    return done


def main(tries="8", first_seed="0"):
    mi.set_variant("llvm_ad_rgb")
    mi.set_log_level(mi.LogLevel.Error)
    run(int(tries), int(first_seed), 32, lambda t: print(t, flush=True))


if __name__ == "__main__":
    main(*sys.argv[1:])
