"""The bandwidth at which a kernel does best: downhill from the automatic one, on seeds of its own.

Radii are multiples of the automatic radius. From 1 and 1/2 the search goes on in factors of 2
towards smaller errors until they grow again, then tries √2 to both sides of the best. "Best" is
the smallest relative MSE after a given time; it holds for that time and scene.
"""

from __future__ import annotations

from collections.abc import Callable
from math import isfinite, sqrt

# Largest and smallest multiple that is tried.
RANGE = (1 / 32, 4.0)


def best(error: Callable[[float], float], fine: bool = True) -> tuple[float, dict[float, float]]:
    """(best factor, error of every factor tried, ascending).

    error  of a run at that multiple of the automatic radius; NaN or infinite where it failed.
    fine   try the factors √2 beside the best one as well.
    """
    errors: dict[float, float] = {}

    def at(factor: float) -> float:
        if factor not in errors:
            value = error(factor)
            errors[factor] = value if isfinite(value) else float("inf")
        return errors[factor]

    # --- Downhill in factors of two ---
    factor, step = (1.0, 2.0) if at(1.0) < at(0.5) else (0.5, 0.5)
    while RANGE[0] <= factor * step <= RANGE[1] and at(factor * step) < at(factor):
        factor *= step

    # --- And between them ---
    if fine:
        for beside in (factor / sqrt(2), factor * sqrt(2)):
            at(beside)
    return min(errors, key=errors.__getitem__), dict(sorted(errors.items()))
