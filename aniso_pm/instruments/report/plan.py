"""What is to be run: methods, budgets, seeds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from aniso_pm.errors import InputError

from .methods import QUICK, STANDARD

# Budgets span two decades.
_SPAN = 100.0
# Reported seeds are 0, 1, 2, …; everything that is chosen is chosen on other ones.
SWEEP_SEED, REGION_SEED, WARM_SEED = 1000, 2000, 3000


@dataclass(frozen=True)
class Plan:
    """The experiment on each scene.

    methods      names, see ``methods``.
    seconds      largest budget; the smallest is a hundredth of it.
    budgets      how many, in equal steps of their logarithm.
    seeds        independent runs of each method; intervals need three.
    photons      light paths of a pass of the photon mappers whose kernels are compared.
    spp          samples per pixel of such a pass.
    early        share of the largest budget up to which pictures are taken from another run, whose
                 passes are an eighth of that: who has less time takes smaller passes.
    sweep_share  of the largest budget: the time of the runs of a sweep.
    sweep_seeds  runs at each bandwidth of a sweep.
    fine         try bandwidths in steps of √2, not of 2 only.
    quick        said on the page.
    denoise      run every method a second time, with what denoising needs, and measure the denoised
                 pictures as well.

    Raises InputError for values out of range.
    """

    methods: tuple[str, ...] = STANDARD
    seconds: float = 5.0
    budgets: int = 7
    seeds: int = 5
    photons: int = 250_000
    spp: int = 8
    early: float = 0.1
    sweep_share: float = 0.2
    sweep_seeds: int = 2
    fine: bool = True
    quick: bool = False
    denoise: bool = False

    def __post_init__(self):
        for name, low, high in (
            ("seconds", 0.1, 1e6),
            ("budgets", 2, 50),
            ("seeds", 3, 1000),
            ("photons", 1000, 2 * 10**8),
            ("spp", 1, 10**6),
            ("early", 0, 0.99),
            ("sweep_share", 0.01, 1),
            ("sweep_seeds", 2, 1000),
        ):
            value = getattr(self, name)
            if not low <= value <= high:
                raise InputError(f"report: {name} is {value}; it must be {low:g} to {high:g}")
        if not self.methods:
            raise InputError("report: no methods; name at least one")

    @classmethod
    def quickly(cls, **changes) -> Plan:
        """A plan for a look: fewer methods, seeds and budgets, shorter runs, smaller passes."""
        few = {"methods": QUICK, "seconds": 1.5, "budgets": 5, "seeds": 3}
        few |= {"photons": 60_000, "spp": 2, "early": 0.0}
        few |= {"sweep_share": 0.6, "fine": False, "quick": True}
        return cls(**few | changes)

    @property
    def times(self) -> list[float]:
        """The budgets in seconds, ascending."""
        times = np.geomspace(self.seconds / _SPAN, self.seconds, self.budgets)
        return [float(f"{t:.3g}") for t in times]

    @property
    def sizes(self) -> dict[str, Size]:
        """Sizes of passes of the photon mappers, each with the budgets that it is for."""
        early = [t for t in self.times if t <= self.early * self.seconds]
        late = [t for t in self.times if t not in early]
        few, one = max(1, self.photons // 8), max(1, self.spp // 8)
        found = {
            "small": Size(few, one, early, self.early * self.seconds),
            "large": Size(self.photons, self.spp, late, self.sweep_share * self.seconds),
        }
        return {name: size for name, size in found.items() if size.times}


@dataclass(frozen=True)
class Size:
    """Passes of one size.

    photons, spp   light paths and samples per pixel of a pass.
    times          the budgets that are taken from a run of such passes.
    sweep_seconds  time of the runs that look for their best bandwidth.
    """

    photons: int
    spp: int
    times: list[float]
    sweep_seconds: float
