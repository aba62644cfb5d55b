"""What is found out about a pixel, as plain numbers: no Dr.Jit array is kept."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np


@dataclass(frozen=True)
class Vertex:
    """A place where the eye path scatters.

    depth      path segments from the camera.
    shape      its id and the classes of its BSDF.
    p, n       position, world units; geometric normal.
    scatters   what the path does there: "glossy reflection", "delta transmission" …
    roughness  (alpha_u, alpha_v), or None where there is none, or none that can be read.
    gathers    does the path read the photon map here?
    """

    depth: int
    shape: str
    p: tuple[float, ...]
    n: tuple[float, ...]
    scatters: str
    roughness: tuple[float, float] | None
    gathers: bool


@dataclass(frozen=True)
class Lobe:
    """The anisotropic spherical Gaussian that arrives at the gather point; world space.

    x, y, z   its axes, unit vectors.
    lam, mu   bandwidths of x and y, 1/rad².
    sigma     standard deviations along x and y, degrees.
    r         direction in which the path left it, unit vector.
    off       how far r is from the lobe's centre, in standard deviations.
    distance  travelled since, world units.
    """

    x: tuple[float, ...]
    y: tuple[float, ...]
    z: tuple[float, ...]
    lam: float
    mu: float
    sigma: tuple[float, float]
    r: tuple[float, ...]
    off: float
    distance: float


@dataclass(frozen=True)
class Kernel:
    """The kernel of the gather point: exp(−(d·s)²/|s|⁴ − (d·t)²/|t|⁴), cut at 4 in the exponent.

    follows_lobe  is it an ellipse that follows the lobe? else it is a disc.
    why           the reason, in words.
    s, t          half axes, world units; |s| >= |t|. aspect: |s|/|t|.
    area          π |s| |t|, world units².
    clamped, capped, off_surface  fallbacks that acted, as counted in the integrator's statistics.
    """

    follows_lobe: bool
    why: str
    s: tuple[float, ...]
    t: tuple[float, ...]
    aspect: float
    area: float
    clamped: bool
    capped: bool
    off_surface: bool


@dataclass(frozen=True)
class Photons:
    """Photons around the gather point, in its tangent frame: x along s, y along t, world units.

    A random choice where there are more than 10,000 inside the kernel, or outside.

    xy       N × 2.
    weight   of the kernel, 0 to 1.
    counted  does the kernel sum the photon up?
    facing   is it on the same surface (normal and offset)?
    total    photons in the map.
    """

    xy: np.ndarray
    weight: np.ndarray
    counted: np.ndarray
    facing: np.ndarray
    total: int


@dataclass(frozen=True)
class Facts:
    """What ``explain`` has found.

    pixel         (x, y) from the top left of the film.
    pass_index, seed  of the photon map.
    radius        bandwidth, world units. photon_count: light paths.
    parameters    of the integrator that decide about kernels.
    samples       eye paths traced through the pixel.
    gather_points, following  their gather points, and how many of them follow a lobe.
    pixel_radiance  the photon map's part of the pixel, mean over the samples (W/m²/sr a channel).
    sample        number of the eye path that is shown, or None.
    sentence      what there is to know before anything else.
    path          its vertices.
    lobe          None where no anisotropic lobe arrives.
    kernel        None where the path reads no photon map, and all below.
    photons_inside  that the kernel sums up.
    contribution  of the gather point to the eye path's radiance (W/m²/sr a channel).
    """

    pixel: tuple[int, int]
    pass_index: int
    seed: int
    radius: float | None
    photon_count: int
    parameters: dict[str, Any]
    samples: int
    gather_points: int
    following: int
    pixel_radiance: tuple[float, ...]
    sample: int | None
    sentence: str
    path: list[Vertex] = field(default_factory=list)
    lobe: Lobe | None = None
    kernel: Kernel | None = None
    photons_inside: int | None = None
    contribution: tuple[float, ...] | None = None
    photons: Photons | None = field(default=None, repr=False)
    outlines: dict[str, np.ndarray] = field(default_factory=dict, repr=False)

    def data(self) -> dict[str, Any]:
        """Everything but the single photons, as JSON has it."""
        found = asdict(self)
        del found["photons"], found["outlines"]
        return found
