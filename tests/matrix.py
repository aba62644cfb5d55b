"""The scenes that transport is checked on, drawn up as data: a room, a light, objects.

``python tests/matrix.py`` renders the converged references, tests/matrix.json, with an integrator
that is not ours (about an hour on two cores; ``python tests/matrix.py NAME ...`` makes some rows).
``python tests/matrix.py --compare [NAME ...]`` prints our energy for every use of the map.
"""

import argparse
import json
import math
from dataclasses import dataclass, field
from pathlib import Path

import aniso_pm  # noqa: F401 (registers the plugins)
import drjit as dr
import mitsuba as mi
import numpy as np
from energy import indirect
from rooms import room, wall

REFERENCE = Path(__file__).with_name("matrix.json")
TILES = str(REFERENCE.parents[1] / "scenes" / "textures" / "tiles.png")
USES = {
    "global": {"map": "global"},
    "caustic": {"map": "caustic"},
    "final gather": {"final_gather": True},
}
# Small against the room (2 units): kernel blur moves light by less than the tolerance.
PHOTON_MAPPER = {"type": "aniso_pm", "initial_radius": 0.01, "alpha": 1.0, "photon_count": 200_000}
SIZE = 16


@dataclass(frozen=True)
class Row:
    """One scene of the matrix.

    light      name in LIGHTS.
    objects    shapes added to the room.
    drop       shapes of the room left out.
    reference  integrator that converges on it.
    spp        samples per pixel of a reference render.
    whole      compare all light, not the indirect light alone.
    passes     of ours, as many as its noise of photons takes.
    """

    light: str = "area"
    objects: dict = field(default_factory=dict)
    drop: tuple = ()
    reference: str = "path"
    spp: int = 4096
    whole: bool = False
    passes: int = 4


def T():
    return mi.ScalarTransform4f()


def rgb(*value):
    return {"type": "rgb", "value": list(value) if len(value) > 1 else value[0]}


def image(shape, seed, raw=False, low=0.0, high=1.0):
    """A bitmap of random texels."""
    data = np.random.default_rng(seed).uniform(low, high, shape).astype(np.float32)
    return {"type": "bitmap", "bitmap": mi.Bitmap(data), "raw": raw, "filter_type": "nearest"}


def ball(bsdf, y=-0.45, radius=0.4):
    return {"ball": {"type": "sphere", "center": [0.1, y, -0.2], "radius": radius, "bsdf": bsdf}}


def block(bsdf):
    to_world = T().translate([0.1, -0.6, -0.2]).rotate([0, 1, 0], 30).scale(0.38)
    return {"block": {"type": "cube", "to_world": to_world, "bsdf": bsdf}}


def plate(bsdf, name="plate", x=0.05, turn=0, both=True):
    to_world = T().translate([x, -0.35, -0.6]).rotate([0, 1, 0], turn).rotate([1, 0, 0], -20)
    bsdf = {"type": "twosided", "b": bsdf} if both else bsdf
    return {name: {"type": "rectangle", "to_world": to_world.scale(0.5), "bsdf": bsdf}}


def register_user_bsdf():
    """A BSDF as users write them: nothing but the interface tells what it is."""

    class UserBSDF(mi.BSDF):
        def __init__(self, props):
            super().__init__(props)
            flags = mi.BSDFFlags.DiffuseReflection | mi.BSDFFlags.FrontSide
            self.m_components = [flags]
            self.m_flags = flags

        def sample(self, ctx, si, sample1, sample2, active=True):
            bs = dr.zeros(mi.BSDFSample3f)
            bs.wo = mi.warp.square_to_cosine_hemisphere(sample2)
            bs.pdf = mi.warp.square_to_cosine_hemisphere_pdf(bs.wo)
            bs.eta = 1.0
            bs.sampled_type = mi.UInt32(+mi.BSDFFlags.DiffuseReflection)
            bs.sampled_component = mi.UInt32(0)
            value = self.eval(ctx, si, bs.wo, active)
            return bs, dr.select(bs.pdf > 0, value / bs.pdf, 0)

        def eval(self, ctx, si, wo, active=True):
            up = active & (mi.Frame3f.cos_theta(si.wi) > 0) & (mi.Frame3f.cos_theta(wo) > 0)
            # Darker the further apart: not Lambertian
            albedo = 0.3 + 0.4 * dr.square(dr.dot(si.wi, wo))
            return dr.select(up, mi.Spectrum(albedo * dr.inv_pi * wo.z), 0)

        def pdf(self, ctx, si, wo, active=True):
            up = active & (mi.Frame3f.cos_theta(si.wi) > 0)
            return dr.select(up, mi.warp.square_to_cosine_hemisphere_pdf(wo), 0)

        def eval_pdf(self, ctx, si, wo, active=True):
            return self.eval(ctx, si, wo, active), self.pdf(ctx, si, wo, active)

        def traverse(self, callback):
            pass

    mi.register_bsdf("userbsdf", UserBSDF)


def lights():
    """Name → (what replaces the room's lamp, must the ceiling go?)."""
    area = {"type": "area", "radiance": rgb(8, 7.5, 7)}
    black = {"type": "diffuse", "reflectance": rgb(0)}
    sky = np.full((8, 16, 3), 0.4, np.float32)
    sky[1:3, 3:6] = [9, 8, 6]
    down = T().translate([0, 0.9, 0]).look_at([0, 0, 0], [0.15, -1, -0.3], [0, 0, 1])
    rectangle = T().translate([0, 0.98, -0.1]).rotate([1, 0, 0], 90).scale(0.4)
    ceiling = {"type": "rectangle", "to_world": rectangle, "bsdf": black}
    textured = {"type": "area", "radiance": image((4, 4, 3), 7, True, 0, 16)}
    turn = T().rotate([1, 0, 0], -60).scale([-1, 1, 1])
    point = {"type": "point", "position": [0.3, 0.6, 0.3], "intensity": rgb(2, 2, 2.5)}
    return {
        "area": ({"light": ceiling | {"emitter": area}}, False),
        "sphere": (
            {"light": {"type": "sphere", "center": [0.4, 0.5, 0], "radius": 0.2, "emitter": area}},
            False,
        ),
        "mesh": (
            {
                "light": {
                    "type": "cube",
                    "to_world": T().translate([0, 0.6, 0]).rotate([1, 1, 0], 40).scale(0.15),
                    "bsdf": black,
                    "emitter": area,
                }
            },
            False,
        ),
        "textured": ({"light": ceiling | {"emitter": textured}}, False),
        "point": ({"light": point}, False),
        "spot": (
            {"light": {"type": "spot", "to_world": down, "intensity": rgb(9), "cutoff_angle": 50}},
            False,
        ),
        "projector": (
            {
                "light": {
                    "type": "projector",
                    "to_world": down,
                    "irradiance": image((4, 4, 3), 5),
                    "fov": 70,
                }
            },
            False,
        ),
        "directional": (
            {"light": {"type": "directional", "direction": [0.3, -1, -0.4], "irradiance": rgb(3)}},
            True,
        ),
        "directionalarea": (
            {"light": ceiling | {"emitter": {"type": "directionalarea", "radiance": rgb(4)}}},
            False,
        ),
        "constant": ({"light": {"type": "constant", "radiance": rgb(1, 1.1, 1.3)}}, True),
        "envmap": (
            {"light": {"type": "envmap", "bitmap": mi.Bitmap(sky), "scale": 1.0}},
            True,
        ),
        "turned envmap": (
            {"light": {"type": "envmap", "bitmap": mi.Bitmap(sky), "to_world": turn}},
            True,
        ),
        "turned sunsky": (
            {
                "light": {
                    "type": "sunsky",
                    "sun_direction": [0.2, 0.4, 1],
                    "sun_scale": 0.2,
                    "to_world": turn,
                }
            },
            True,
        ),
        "turned sphere": (
            {
                "light": {
                    "type": "sphere",
                    "to_world": T().translate([0.4, 0.5, 0]).rotate([1, 0, 0], 160).scale(0.2),
                    "emitter": area,
                }
            },
            False,
        ),
        "sunsky": (
            {"light": {"type": "sunsky", "sun_direction": [0.2, 1, 0.4], "sun_scale": 0.2}},
            True,
        ),
        "several": (
            {
                "light": {"type": "constant", "radiance": rgb(0.3)},
                "lamp": ceiling | {"emitter": {"type": "area", "radiance": rgb(2)}},
                "bulb": point,
            },
            True,
        ),
    }


def rows():
    """Name → Row."""
    diffuse = {"type": "diffuse", "reflectance": rgb(0.6, 0.5, 0.4)}
    mirror = {"type": "conductor"}
    glass = {"type": "dielectric"}
    brushed = {"type": "roughconductor", "material": "Al", "alpha_u": 0.05, "alpha_v": 0.3}
    rough = {"type": "roughconductor", "material": "Cu", "alpha": 0.4}
    glossy = {"type": "roughplastic", "alpha": 0.1, "diffuse_reflectance": rgb(0.5, 0.3, 0.3)}
    matt = glossy | {"alpha": 0.4}
    satin = {
        "type": "principled",
        "base_color": rgb(0.6, 0.5, 0.3),
        "roughness": 0.5,
        "specular": 0.5,
    }
    blend = lambda a, b: {"type": "blendbsdf", "weight": 0.4, "a": a, "b": b}  # noqa: E731
    bump = lambda b: {  # noqa: E731
        "type": "bumpmap",
        "scale": 0.1,
        "map": {"type": "bitmap", "filename": TILES, "raw": True},
        "b": b,
    }
    mask = lambda b: {"type": "mask", "opacity": 0.6, "b": {"type": "twosided", "b": b}}  # noqa: E731
    normal = image((4, 4, 3), 3, True, 0.4, 0.6)
    texels = np.array(normal["bitmap"]) * [1, 1, 0] + [0, 0, 0.95]
    normal["bitmap"] = mi.Bitmap(texels.astype(np.float32))
    normalmap = lambda b: {"type": "normalmap", "normalmap": normal, "b": b}  # noqa: E731
    tilt = np.full((2, 2, 3), 0.5, np.float32) + 0.5 * np.float32([0.259, 0, 0.966])  # 15 degrees
    tilted = lambda b: {  # noqa: E731
        "type": "normalmap",
        "normalmap": {"type": "bitmap", "bitmap": mi.Bitmap(tilt), "raw": True},
        "b": b,
    }
    chequers = {"type": "checkerboard", "color0": 0.9, "color1": 0.0}
    chequers["to_uv"] = T().scale([6, 6, 1])
    floor = lambda b: {"floor": wall(T().translate([0, -1, 0]).rotate([1, 0, 0], -90), None, b)}  # noqa: E731
    table = {
        # --- every light on diffuse surfaces ---
        "area, diffuse": Row(objects=block(diffuse)),
        "sphere light, diffuse": Row("sphere", block(diffuse)),
        "mesh light, diffuse": Row("mesh", block(diffuse)),
        "textured light, diffuse": Row("textured", block(diffuse)),
        "point, diffuse": Row("point", block(diffuse)),
        "spot, diffuse": Row("spot", block(diffuse)),
        "projector, diffuse": Row("projector", block(diffuse)),
        "directional, diffuse": Row("directional", block(diffuse)),
        "directionalarea, diffuse": Row(
            "directionalarea", block(diffuse), reference="ptracer", spp=8192, whole=True
        ),
        "constant, diffuse": Row("constant", block(diffuse)),
        "envmap, diffuse": Row("envmap", block(diffuse)),
        "sunsky, diffuse": Row("sunsky", block(diffuse)),
        "several lights, diffuse": Row("several", block(diffuse)),
        "turned envmap, diffuse": Row("turned envmap", block(diffuse)),
        "turned sunsky, diffuse": Row("turned sunsky", block(diffuse)),
        "turned sphere light, diffuse": Row("turned sphere", block(diffuse)),
        "mirrored block and plate": Row(
            objects={
                "block": {
                    "type": "cube",
                    "to_world": T().translate([0.4, -0.6, 0.2]).scale([-0.3, 0.38, 0.3]),
                    "bsdf": diffuse,
                },
                "plate": {
                    "type": "rectangle",
                    "to_world": T().translate([-0.3, -0.3, -0.4]).scale([0.5, 0.5, -1]),
                    "bsdf": {"type": "twosided", "b": diffuse},
                },
            }
        ),
        # --- every material ---
        "conductor": Row(objects=ball(mirror)),
        "roughconductor 0.1": Row(objects=ball(rough | {"alpha": 0.1})),
        "roughconductor 0.4": Row(objects=ball(rough)),
        "brushed conductor": Row(objects=plate(brushed)),
        "brushed GGX conductor": Row(objects=ball(brushed | {"distribution": "ggx"})),
        "dielectric": Row(objects=ball(glass), spp=32768),
        "thindielectric": Row(objects=ball({"type": "thindielectric"}), spp=16384),
        "roughdielectric 0.2": Row(
            objects=ball({"type": "roughdielectric", "alpha": 0.2}), spp=16384
        ),
        "brushed dielectric": Row(
            objects=ball({"type": "roughdielectric", "alpha_u": 0.1, "alpha_v": 0.4}), spp=16384
        ),
        "plastic": Row(objects=ball({"type": "plastic"}), spp=16384),
        "roughplastic 0.1": Row(objects=ball(glossy)),
        "roughplastic 0.4": Row(objects=ball(matt)),
        "principled": Row(objects=ball(satin)),
        "brushed principled": Row(objects=ball(satin | {"metallic": 1.0, "anisotropic": 0.9})),
        "principled glass": Row(
            objects=ball({"type": "principled", "roughness": 0.4, "spec_trans": 0.9, "eta": 1.4}),
            spp=16384,
        ),
        "principledthin": Row(
            objects=ball({"type": "principledthin", "roughness": 0.5, "diff_trans": 0.8})
        ),
        "hair": Row(objects=ball({"type": "hair"}, radius=0.3)),
        "null": Row(objects=ball({"type": "null"})),
        "asgconductor": Row(
            objects=plate(
                {"type": "asgconductor", "material": "Al", "alpha_u": 0.05, "alpha_v": 0.3}
            )
        ),
        "textured roughness": Row(
            objects=plate(
                brushed | {"alpha_u": image((2, 2, 1), 1, True, 0.1, 0.5), "alpha_v": 0.3}
            )
        ),
        "BSDF written in Python": Row(objects=ball({"type": "userbsdf"})),
        # --- wrappers ---
        "twosided blend of diffuse and brushed": Row(objects=plate(blend(diffuse, brushed))),
        "blend of diffuse and mirror": Row(objects=ball(blend(diffuse, mirror))),
        "mask of brushed": Row(
            objects=plate(
                {"type": "mask", "opacity": 0.6, "b": {"type": "twosided", "b": brushed}},
                both=False,
            )
        ),
        "mask of diffuse": Row(objects=ball(mask(diffuse)), reference="prb"),
        "bumpmap of roughplastic": Row(objects=plate(bump(glossy))),
        "normalmap of roughconductor": Row(objects=plate(normalmap(rough | {"alpha": 0.2}))),
        "tilted diffuse floor under a spot": Row("spot", floor(tilted(diffuse))),
        "tilted metal floor under a spot": Row("spot", floor(tilted(rough | {"alpha": 0.1}))),
        "black chequers": Row(objects=floor({"type": "diffuse", "reflectance": chequers})),
        "bump of mask of twosided": Row(
            objects=plate(bump(mask(matt)), both=False), reference="prb"
        ),
        # --- geometry ---
        "instanced plastic": Row(
            objects={
                "group": {"type": "shapegroup"} | ball({"type": "plastic"}),
                "instance": {"type": "instance", "group": {"type": "ref", "id": "group"}},
            },
            spp=16384,
        ),
        "analytic shapes": Row(
            objects={
                "disk": {
                    "type": "disk",
                    "to_world": T().translate([-0.4, -0.5, 0]).rotate([1, 0, 0], -70).scale(0.4),
                    "bsdf": {"type": "twosided", "b": brushed},
                },
                "tube": {
                    "type": "cylinder",
                    "p0": [0.4, -1, 0],
                    "p1": [0.4, 0, -0.3],
                    "radius": 0.2,
                    "bsdf": {"type": "twosided", "b": diffuse},
                },
            }
        ),
        "curve": Row(
            objects={
                "curve": {
                    "type": "bsplinecurve",
                    "filename": str(REFERENCE.with_name("curve.txt")),
                    "bsdf": {"type": "twosided", "b": diffuse},
                }
            }
        ),
        # --- paths ---
        "two brushed plates": Row(
            objects=plate(brushed, "left plate", -0.5, 40)
            | plate(brushed, "right plate", 0.55, -40)
        ),
        "mirror that sees a caustic": Row(
            objects=ball(glass, -0.5, 0.3) | plate(mirror, turn=25), spp=32768
        ),
        "roughplastic floor under glass": Row(objects=floor(glossy) | ball(glass), spp=32768),
        "rough metal floor under glass": Row(objects=floor(rough) | ball(glass), spp=32768),
        "light inside glass": Row(
            "sphere",
            {
                "shell": {
                    "type": "sphere",
                    "center": [0.4, 0.5, 0],
                    "radius": 0.3,
                    "bsdf": {"type": "dielectric"},
                }
            },
            spp=32768,
        ),
        "lamp behind a thin wall": Row(
            "sphere",
            {
                "wall": {
                    "type": "rectangle",
                    "to_world": T().translate([0.1, 0, 0]).rotate([0, 1, 0], 80),
                    "bsdf": {"type": "twosided", "b": diffuse},
                }
            },
            passes=16,
        ),
        # --- materials under other lights ---
        "rough metal under a point": Row("point", ball(rough)),
        "brushed plate under the sun": Row("directional", plate(brushed)),
        "roughplastic under a spot": Row("spot", ball(glossy)),
        "principled under an envmap": Row("envmap", ball(satin)),
        "mask under a constant": Row("constant", ball(mask(diffuse)), reference="prb"),
        "bumped blend under several": Row("several", plate(bump(blend(diffuse, rough)))),
    }
    return table


def make(row, size=SIZE):
    """The scene of a row."""
    register_user_bsdf()
    scene = room(size=size)
    light, open_ = lights()[row.light]
    for name in ("light", *(("ceiling",) if open_ else ()), *row.drop):
        del scene[name]
    return mi.load_dict(scene | light | row.objects)


def mean_and_error(row, integrator, spp, seeds):
    """Mean of the indirect light over the image, and its standard error over the seeds."""
    scene = make(row)
    if row.whole:
        plugin = mi.load_dict(integrator)
        images = (mi.render(scene, integrator=plugin, spp=spp, seed=seed) for seed in seeds)
        values = [np.array(image, dtype=np.float64).mean() for image in images]
    else:
        values = [indirect(scene, integrator, -1, spp, seed).mean() for seed in seeds]
    return float(np.mean(values)), float(np.std(values, ddof=1) / len(values) ** 0.5)


def compare(row, use, expected, seeds=range(8), passes=None, share=8):
    """(ratio of our energy to the reference's, standard error of both together). We take 1/share
    of the reference's samples per pixel, in so many passes; None: in those of the row."""
    passes = passes or row.passes
    integrator = PHOTON_MAPPER | USES[use] | {"passes": passes}
    mean, error = mean_and_error(row, integrator, max(row.spp // share, passes), seeds)
    return mean / expected[0], math.hypot(error, expected[1]) / expected[0]


def main():
    mi.set_variant("llvm_ad_rgb")
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--compare", action="store_true")
    arguments = parser.parse_args()
    known = json.loads(REFERENCE.read_text()) if REFERENCE.exists() else {}
    for name, row in rows().items():
        if arguments.names and name not in arguments.names:
            continue
        if arguments.compare and name not in known:
            print(f"{name:38s} has no reference yet")
            continue
        if arguments.compare:
            results = {use: compare(row, use, known[name]) for use in USES}
            print(f"{name:38s}", *(f"{r:.4f} ± {e:.4f}" for r, e in results.values()), flush=True)
            continue
        mean, error = mean_and_error(
            row, {"type": row.reference, "rr_depth": 16}, row.spp, range(1000, 1008)
        )
        known[name] = [float(f"{mean:.6g}"), float(f"{error:.3g}")]
        print(f"{name:38s}", known[name], f"{error / mean:.2%}", flush=True)
        REFERENCE.write_text(json.dumps(known, indent=1, sort_keys=True) + "\n")


if __name__ == "__main__":
    main()
