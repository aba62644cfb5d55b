"""Cases about whole pictures: scales, broken geometry, dark and impossible light, odd films.

Energy is compared with Mitsuba's ``path`` on the same scene: the mean of the picture, two seeds
each. A single pixel that is not finite makes the error not a number, and the case fail.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache, partial

import mitsuba as mi
import numpy as np
from aniso_pm.rendering import beginning
from aniso_pm.transport import photons

from .case import Case, Measured
from .worlds import Place, ball, diffuse, film, grey, mesh, plate, room

FALLBACKS = ("clamped", "capped", "degenerate")
# Energy: 1 % of closed rooms is what the energy tests allow; Monte Carlo errors below 0.5 %.
ENERGY = 0.02
_OURS = {"type": "aniso_pm", "map": "global", "photon_count": 50_000}
GLASS = {"type": "dielectric", "int_ior": 1.5}


def shares(statistics) -> float:
    """Share of gather points in which a fallback acted."""
    acted = sum(statistics[f"gather_points_{name}"] for name in FALLBACKS)
    return acted / max(1, statistics["gather_points"])


def picture(scene, integrator, spp, seed=0):
    plugin = mi.load_dict(integrator)
    image = np.array(mi.render(scene, integrator=plugin, spp=spp, seed=seed), np.float64)
    return image, getattr(plugin, "statistics", {})


def energy(scene, integrator, spp, seeds=(1, 2)):
    """(mean of the pictures, statistics of the last); not a number if any pixel is not finite."""
    pairs = [picture(scene, integrator, spp, seed) for seed in seeds]
    return float(np.mean([image.mean() for image, _ in pairs])), pairs[-1][1]


def _against_path(make, spp=48, path_spp=768, **ours) -> Measured:
    """Mean of our picture over path's, − 1. Where path is black, so must ours be."""
    scene = mi.load_dict(make())
    mean, statistics = energy(scene, _OURS | ours, spp)
    wanted, _ = energy(scene, {"type": "path"}, path_spp)
    error = abs(mean / wanted - 1) if wanted else (0.0 if mean == 0 else math.inf * mean)
    return Measured(error, f"ours {mean:.4g}, path {wanted:.4g}", shares(statistics))


# --- Scales --------------------------------------------------------------------------------------


@cache
def _scaled(scale, offset, kind, integrator, spp) -> float:
    # Mitsuba's variant is part of the answer, but the command runs in one.
    extra = (lambda place: {"plate": plate(place)}) if kind == "plate" else None
    scene = mi.load_dict(room(extra, Place(scale, offset)))
    parameters = _OURS | {"passes": 4} if integrator == "aniso_pm" else {"type": "path"}
    return energy(scene, parameters, spp, (1, 2, 3))[0]


def _against_itself(scale, offset, kind="plate") -> Measured:
    """Our picture at that scale over our picture at scale 1 at the origin, − 1."""
    here, there = (_scaled(*at, kind, "aniso_pm", 64) for at in ((scale, offset), (1.0, 0.0)))
    return Measured(abs(here / there - 1), f"{here:.4f} here, {there:.4f} at scale 1")


def _against_path_there(scale, offset) -> Measured:
    """How far our picture is from path's at the same scale, beyond what path's own ray offsets
    have moved its picture from the one at scale 1."""
    (ours, ours_1), (path, path_1) = (
        [_scaled(*at, "empty", *how) for at in ((scale, offset), (1.0, 0.0))]
        for how in (("aniso_pm", 64), ("path", 512))
    )
    distance, moved = abs(ours / path - ours_1 / path_1), abs(path / path_1 - 1)
    words = f"ours/path {ours / path:.4f} here, {ours_1 / path_1:.4f} at scale 1"
    words += f"; path/path {path / path_1:.4f}"
    return Measured(max(distance - moved, 0.0), words)


# --- Geometry ------------------------------------------------------------------------------------


def _floor_mesh(vertices_x, extra_faces=()):
    """The room's floor as strips between the given x, with more faces appended."""
    x = np.asarray(vertices_x)
    vertices = np.array([(a, -1.0, z) for a in x for z in (1.0, -1.0)])
    faces = []
    for i in range(len(x) - 1):
        a, b, c, d = 2 * i, 2 * i + 1, 2 * i + 2, 2 * i + 3
        faces += [(a, c, b), (b, c, d)]
    return vertices, np.array(faces + list(extra_faces))


def _needles():
    """A floor of 2,000 strips, 1,000 of them a millionth wide: triangles of aspect 2e6."""
    x = np.linspace(-1, 1, 1001)
    x = np.sort(np.concatenate([x, x[:-1] + 1e-6]))
    return room(lambda p: {"floor": mesh("floor", *_floor_mesh(x), diffuse(0.6))})


def _zero_area():
    """A floor with triangles without area, and with every triangle twice."""
    vertices, faces = _floor_mesh(np.linspace(-1, 1, 11))
    flat = [(0, 0, 1), (2, 2, 2), (0, 4, 8), (1, 5, 9)]
    faces = np.concatenate([faces, faces, flat])
    return room(lambda p: {"floor": mesh("floor", vertices, faces, diffuse(0.6))})


def _plate_without_uv():
    """The brushed plate as a mesh without texture coordinates: no tangent to brush along."""
    c, s = math.cos(math.radians(20)), math.sin(math.radians(20))
    corners = [(x * 0.55, y * 0.55 * c, -y * 0.55 * s) for y in (-1, 1) for x in (-1, 1)]
    vertices = np.array(corners) + [0.05, -0.35, -0.6]
    bsdf = plate(Place())["bsdf"]
    faces = np.array([(0, 1, 2), (1, 3, 2)])
    return room(lambda p: {"plate": mesh("plate", vertices, faces, bsdf)})


def _inverted(what):
    if what == "walls":
        scene = room(lambda p: {"plate": plate(p)})
        for name in ("left", "right"):
            scene[name]["flip_normals"] = True
        return scene
    bsdf = {
        "glass": GLASS,
        "metal": {"type": "roughconductor", "material": "Al", "alpha_u": 0.05, "alpha_v": 0.3},
    }[what]
    return room(lambda p: {"ball": ball(p, bsdf) | {"flip_normals": True}})


# --- Light ---------------------------------------------------------------------------------------


def _lit_by(emitter):
    """Without glass: path cannot find the caustics of lights without area."""
    return room(lambda p: {"lamp": emitter, "plate": plate(p)}, without=("light",))


def _boxed_light():
    """A lamp in a closed box of its own: nothing may leave it."""
    T = mi.ScalarTransform4f
    box = {
        "type": "cube",
        "to_world": T().scale(0.2),
        "bsdf": {"type": "twosided", "bsdf": diffuse(0.5)},
    }
    lamp = {"type": "sphere", "radius": 0.05, "emitter": {"type": "area", "radiance": grey(100.0)}}
    return room(lambda p: {"box": box, "lamp": lamp}, without=("light",))


def _camera_in_glass():
    return room(lambda p: {"ball": ball(p, GLASS, (0, 0, 0.9), 0.5)})


def _projector():
    """Mitsuba's projector returns weights that are not numbers for some samples where its picture
    is mostly dark."""
    T = mi.ScalarTransform4f
    lit = np.random.default_rng(0).random((64, 64, 1)) < 0.05
    image = mi.Bitmap(np.repeat(lit, 3, 2).astype(np.float32))
    projector = {
        "type": "projector",
        "irradiance": {"type": "bitmap", "bitmap": image, "raw": True, "filter_type": "nearest"},
        "to_world": T().look_at(origin=[0, 0.5, 0.8], target=[0, -1, 0], up=[0, 1, 0]),
        "fov": 60,
        "scale": 200.0,
    }
    return _lit_by(projector)


def _infinite_light():
    return room(light=float("inf"))


def _finite_and_counted(make, key, photon_count=50_000) -> Measured:
    """No pixel that is not finite; what was dropped is in the statistics."""
    image, statistics = picture(mi.load_dict(make()), _OURS | {"photon_count": photon_count}, 16)
    of = statistics["photons_emitted" if key == "photons_rejected" else "eye_samples"]
    dropped = statistics[key] / max(1, of)
    error = 0.0 if np.isfinite(image).all() else math.nan
    words = f"{statistics[key]} of {of} dropped, mean {image.mean():.3g}"
    return Measured(error, words, min(dropped, 1.0))


# --- Films and wavefronts ------------------------------------------------------------------------


def _film(width, height) -> Measured:
    """A film of that size against path on the same one: finite, and the same energy."""

    def make():
        scene = room(lambda p: {"plate": plate(p)})
        scene["sensor"]["film"] = film(width, height)
        return scene

    pixels = width * height
    spp = max(2, 30_000 // pixels)
    return _against_path(make, spp, max(8, 400_000 // pixels))


@contextmanager
def _wavefronts(photon_paths, eye_samples) -> Iterator[None]:
    before = photons.WAVEFRONT, beginning.WAVEFRONT
    photons.WAVEFRONT, beginning.WAVEFRONT = photon_paths, eye_samples
    try:
        yield
    finally:
        photons.WAVEFRONT, beginning.WAVEFRONT = before


def _many_wavefronts(photon_paths, eye_samples) -> Measured:
    """The same picture in 20 wavefronts and in one: other random numbers, the same energy."""
    scene = mi.load_dict(room())
    whole, _ = energy(scene, _OURS, 20)
    with _wavefronts(photon_paths, eye_samples):
        parts, statistics = energy(scene, _OURS, 20)
    lost = statistics["photons_emitted"] != 50_000 or statistics["spp"] != 20
    return Measured(math.nan if lost else abs(parts / whole - 1), f"{parts:.4f} and {whole:.4f}")


def _nothing_stored() -> Measured:
    """Black walls: no photon is stored, and the picture is path's."""
    return _against_path(partial(room, albedo=0.0), 16, 64)


def cases() -> list[Case]:
    found = []
    for words, scale, offset in (
        ("scaled by 1e-3", 1e-3, 0.0),
        ("scaled by 1e3", 1e3, 0.0),
        ("translated by 1e3", 1.0, 1e3),
    ):
        found += [
            Case(
                "scale",
                f"room with plate, {words}",
                "energy, ours over ours at scale 1, − 1",
                0.01,
                partial(_against_itself, scale, offset),
                slow=True,
            ),
            Case(
                "scale",
                f"empty room, {words}",
                "energy over path's, beyond path's own movement",
                0.01,
                partial(_against_path_there, scale, offset),
                slow=True,
            ),
        ]
    over_path = "energy over path's, − 1"
    for words, make in (
        ("needle triangles of aspect 2e6", _needles),
        ("zero-area and duplicate triangles", _zero_area),
        ("mesh without UVs under an anisotropic BSDF", _plate_without_uv),
        ("inverted normals: walls", partial(_inverted, "walls")),
        ("inverted normals: glass", partial(_inverted, "glass")),
        ("inverted normals: metal", partial(_inverted, "metal")),
    ):
        found.append(
            Case("geometry", words, over_path, ENERGY, partial(_against_path, make), slow=True)
        )
    T = mi.ScalarTransform4f
    down = T().look_at(origin=[0, 0.9, 0], target=[0.1, -1, 0], up=[0, 0, 1])
    for words, make in (
        (
            "point light: no area",
            partial(_lit_by, {"type": "point", "position": [0, 0.8, 0], "intensity": grey(2.0)}),
        ),
        (
            "spot light: no area",
            partial(_lit_by, {"type": "spot", "to_world": down, "intensity": grey(5.0)}),
        ),
        ("light inside a closed box", _boxed_light),
        ("camera inside glass", _camera_in_glass),
    ):
        found.append(
            Case("light", words, over_path, ENERGY, partial(_against_path, make), slow=True)
        )
    found += [
        Case("light", "black walls: no photon stored", over_path, ENERGY, _nothing_stored),
        Case(
            "light",
            "black lamp",
            over_path,
            ENERGY,
            partial(_against_path, partial(room, light=0.0), 4, 4),
        ),
        Case(
            "light",
            "projector",
            "pixels that are not finite",
            0.0,
            partial(_finite_and_counted, _projector, "photons_rejected", 1_000_000),
            slow=True,
        ),
        Case(
            "light",
            "infinite radiance",
            "pixels that are not finite",
            0.0,
            partial(_finite_and_counted, _infinite_light, "photons_rejected"),
            region="dropped",
        ),
        Case("film", "1 × 1", over_path, ENERGY, partial(_film, 1, 1), slow=True),
        Case("film", "8192 × 64", over_path, ENERGY, partial(_film, 8192, 64), slow=True),
        Case(
            "wavefronts",
            "20 of photons",
            "energy over one wavefront's, − 1",
            0.01,
            partial(_many_wavefronts, 2500, 1 << 21),
            slow=True,
        ),
        Case(
            "wavefronts",
            "20 of eye samples",
            "energy over one wavefront's, − 1",
            0.01,
            partial(_many_wavefronts, 1 << 21, 24 * 24),
            slow=True,
        ),
    ]
    return found
