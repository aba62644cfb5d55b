"""Places where eye paths read the photon map."""

from __future__ import annotations

from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import drjit as dr

from ..lobe_path import GlossyVertex


@dataclass
class GatherPoints:
    """Gather points, along a curve that keeps neighbours together.

    lane       index of the eye path.
    p, n       position; geometric normal of the side that is seen.
    weight     path throughput; times the BRDF value (1/sr) where the receiver is Lambertian.
    depth      path segments from the camera.
    path       GlossyVertex, or None where the scene has no anisotropic lobes.
    origin, d  ray that found p, or None where all receivers are Lambertian.
    lambertian is the receiver Lambertian? None where all are.
    caustic    only caustic photons are to be read; None where all points agree.
    glossy     are glossy caustics seen there (see ``glossy_caustics``)? None where maps have none.
    distance   length of the path from the camera, world units; None where nobody asks.
    later      has the path left a gathered part before? (survey: then points are the caustic map's
               only.) None where nobody asks, or none has.
    wall       walls.Wall beside the point; None where nobody looks.
    """

    lane: Any
    p: Any
    n: Any
    weight: Any
    depth: Any
    path: GlossyVertex | None
    origin: Any
    d: Any
    lambertian: Any
    caustic: Any
    glossy: Any = None
    distance: Any = None
    later: Any = None
    wall: Any = None


def map_tree(function, *trees: Any) -> Any:
    """Apply a function to the Dr.Jit arrays of equal trees of dataclasses (None stays None)."""
    first = trees[0]
    if first is None:
        return None
    if is_dataclass(first):
        kind: Any = type(first)
        return kind(
            **{
                f.name: map_tree(function, *(getattr(t, f.name) for t in trees))
                for f in fields(first)
            }
        )
    return function(*trees)


def take(points, index):
    """The given entries of gather points (or of any tree of dataclasses and Dr.Jit arrays)."""
    return map_tree(lambda v: dr.gather(type(v), v, index), points)
