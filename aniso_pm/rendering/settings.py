"""The integrator's parameters: types, ranges, defaults. The plugin's documentation says what each
one means; this module says what each one may be."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields, replace
from typing import Literal

from ..kernel import RULES
from ..transport import layers

_UNLIMITED = 0xFFFFFFFF


@dataclass(frozen=True)
class Settings:
    """Validated parameters, in Mitsuba's own names. Raises ValueError for a value out of range and
    TypeError for one of the wrong type; the message names parameter, value and accepted range."""

    kernel: str = "auto"
    rule: str = "lobe"
    size: str = "bandwidth"
    epsilon: float = 0.02
    guard: bool = True
    max_aspect: float = 24.0
    map: Literal["global", "caustic", "auto"] = "auto"
    final_gather: bool = False
    gather_roughness: float = 0.2
    photon_count: int = 0
    passes: int = 0
    time: float = 0.0
    target_error: float = 0.0
    alpha: float = 2 / 3
    initial_radius: float = 0.0
    gather_tolerance: float = 0.0
    edge_compensation: bool = True
    max_depth: int = -1
    rr_depth: int = 5
    max_memory: float = 0.0
    layers: str = ""

    def __post_init__(self):
        for field in fields(self):
            value = getattr(self, field.name)
            wanted = type(field.default)
            # Mitsuba hands over integers where a float is meant ("1"), never the reverse.
            if wanted is float and type(value) is int:
                object.__setattr__(self, field.name, float(value))
            elif type(value) is not wanted:
                kinds = {bool: "boolean (true or false)", int: "integer", float: "float"}
                name = kinds.get(wanted, "string")
                raise TypeError(
                    f'aniso_pm: parameter "{field.name}" must be of type {name}, '
                    f"got {value!r} ({type(value).__name__})"
                )
        self._one_of("kernel", "auto", "anisotropic", "isotropic")
        self._one_of("rule", *RULES)
        self._one_of("size", "bandwidth", "epsilon")
        self._between("epsilon", 1e-8, 10)
        self._between("max_aspect", 1, 1e4)
        self._one_of("map", "global", "caustic", "auto")
        if self.final_gather and self.map == "caustic":
            raise ValueError(
                f'aniso_pm: parameter "final_gather" needs the global map, but "map" is '
                f'"{self.map}"; remove one of them'
            )
        self._between("gather_roughness", 0.01, 1e30)
        self._between("photon_count", 0, 2 * 10**8, "between 1 and 2e+08, or 0 (automatic)")
        self._between("time", 0, 1e9, "0 (no limit) or a positive number of up to 1e+09 seconds")
        self._between(
            "target_error", 0, 1e3, "0 (no target) or a positive relative error of up to 1000"
        )
        self._between("passes", 0, 10**7, "between 1 and 1e+07, or 0 (automatic)")
        self._between("alpha", 0, 1, "above 0 and at most 1", self.alpha > 0)
        self._between(
            "initial_radius", 0, 1e30, "0 (automatic) or a positive length of up to 1e+30"
        )
        self._between("gather_tolerance", 0, 1)
        self._between(
            "max_depth", -1, 10**6, "-1 (unlimited) or between 1 and 1e+06", self.max_depth != 0
        )
        self._between("rr_depth", 1, 10**6)
        self._between("max_memory", 0, 1e6, "0 (automatic) or a positive number of up to 1e+06 GiB")
        if "standard_error" in self.layer_names and self.passes == 1:
            raise ValueError(
                'aniso_pm: parameter "layers" asks for "standard_error", which is the spread of '
                'passes, but there is one; set "passes" to 2 or more'
            )

    def _one_of(self, name, *choices):
        value = getattr(self, name)
        if value not in choices:
            raise ValueError(
                f'aniso_pm: parameter "{name}" is "{value}"; it must be one of {", ".join(choices)}'
            )

    def _between(self, name, low, high, words=None, also=True):
        value = getattr(self, name)
        if not (math.isfinite(value) and low <= value <= high and also):
            raise ValueError(
                f'aniso_pm: parameter "{name}" is {value}; '
                f"it must be {words or f'between {low:g} and {high:g}'}"
            )

    @property
    def layer_names(self) -> tuple[str, ...]:
        """The layers that are asked for."""
        return layers.parse(self.layers)

    @property
    def open_ended(self) -> bool:
        """May rendering end before the last pass, by time or error?"""
        return self.time > 0 or self.target_error > 0

    @property
    def endless(self) -> bool:
        """Is there no limit to the number of passes?"""
        return self.passes == 0 and self.open_ended

    @property
    def automatic_passes(self) -> bool:
        """Does their number follow from the samples (``schedule.with_passes``)?"""
        return self.passes == 0 and not self.open_ended

    @property
    def wants_spread(self) -> bool:
        """Is the variance of the picture kept? It takes memory, which nobody expects who has not
        asked for passes."""
        return not self.automatic_passes or "standard_error" in self.layer_names

    @property
    def depth_limit(self) -> int:
        """Path segments of a whole light path, a large number where there is no limit."""
        return _UNLIMITED if self.max_depth == -1 else self.max_depth

    def with_(self, **changes) -> Settings:
        """A copy with some parameters changed, validated again."""
        return replace(self, **changes)
