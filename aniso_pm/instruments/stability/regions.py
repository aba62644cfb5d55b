"""Fallbacks: what is done where the exact answer does not exist or cannot be represented.

None of these limits was fitted to the table. A case lies in a region, and then its answer is a
fallback that was counted, or outside of all of them, and then none may act.
"""

from __future__ import annotations

from dataclasses import dataclass

from aniso_pm.map.density import PROBES_MAX


@dataclass(frozen=True)
class Region:
    """key: as the cases name it. where: the region. instead: what is done there. counted: key of
    the render's statistics, or where else it shows."""

    key: str
    where: str
    instead: str
    counted: str


REGIONS = (
    Region(
        "cap",
        "half axes of the projected ellipse, the guard's disc added, differ by more than "
        "max_aspect",
        "the long axis is shortened and the short one lengthened to that ratio; the area stays",
        "gather_points_capped",
    ),
    Region(
        "clamp",
        "the receiver is seen edge-on: |r·n| < 0.001",
        "|r·n| is taken to be 0.001; with size = bandwidth the area stays radius²",
        "gather_points_clamped",
    ),
    Region(
        "behind",
        "the path left more than 90° from the centre of its lobe (r·z <= 0), or the ellipse is not "
        "finite",
        "the disc",
        "gather_points_degenerate",
    ),
    Region(
        "no gradient",
        'rule "paper" where |∇ ln G| < 1e-14 (2 max(λ, μ) + 1): the printed length ε/|g| is '
        "infinite",
        "that length at the floor, along the steeper axis of the Hessian; the aspect cap then acts",
        "gather_points_capped",
    ),
    Region(
        "warp",
        "the glossy surface is seen edge-on: o·n < 1e-6",
        "the lobe of o·n = 1e-6",
        "no gather points: the surface covers no pixel there",
    ),
    Region(
        "dropped",
        "a flux or a sample that is not finite: an emitter or a BSDF returned NaN or infinity",
        "the photon, or the eye sample, counts as 0; a warning above 0.1 % of the light paths, and "
        "for any eye sample",
        "photons_rejected, eye_samples_rejected",
    ),
    Region(
        "off surface",
        f"{PROBES_MAX} probe rays find no part of a kernel on its surface",
        "no edge compensation for that estimate",
        "gather_points_off_surface",
    ),
)
