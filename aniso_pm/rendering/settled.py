"""What a rendering needs to know before its first pass, given or chosen by a pilot."""

from __future__ import annotations

from dataclasses import asdict, dataclass, fields, replace
from typing import Any

import numpy as np

from ..transport import aim
from ..transport.focus import Focus
from ..transport.uses import Use
from .prepared import Prepared

_ARRAYS = ("share", "counts", "widths")
# Those of ``aim``, as they are called in states.
_AIM = {f"aim_{name}": name for name in ("low", "size", "chance")}


@dataclass(frozen=True)
class Settled:
    """One for all passes of a picture, wherever and whenever they are rendered: states keep it, and
    workers are told.

    use     of the map (see ``uses``).
    errors  relative MSE that each use promises, where there was a choice (see ``survey``).
    count   light paths per pass.
    radius  bandwidth of the first pass, world units.
    each    eye samples of a pixel in a pass (see ``survey``).
    share   of the eye paths of each pixel that gather (see ``thinning``); float32, flat, one for
            each sampled pixel, or one for all.
    counts  samples of each pixel in a pass (see ``allotment``), uint32, flat, or None: all alike.
    widths  of the kernels of each pixel, in pixels (see ``footprint``); as ``share``.
    aim     of light paths (aim.Learned), or None: they begin evenly.
    lobes   part of the error that kernels make which follow lobes (see ``plan``).
    focus   where light from outside begins, or None: anywhere.
    rare    emitters whose caustics on glossy surfaces are photons' (see ``glossy``).
    """

    use: Use
    errors: dict[str, float | None]
    count: int
    radius: float
    each: int
    share: np.ndarray
    counts: np.ndarray | None
    widths: np.ndarray
    aim: aim.Learned | None
    lobes: float
    focus: Focus | None = None
    rare: tuple[str, ...] = ()

    def applied(self, scene: Prepared) -> Prepared:
        """The scene with the use of its map, with or without lobes, and with the number and aim of
        light paths."""
        matter = scene.worth_following(self.lobes)
        aimed = self.aim.aim() if self.aim else None
        scene = scene.focused(self.focus)
        scene = replace(scene, chosen=self.use, aim=aimed, rare=self.rare, lobes_matter=matter)
        return scene.with_(photon_count=self.count)

    def packed(self) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
        """(numbers and words, arrays) for a state; see ``unpacked``."""
        values = {f.name: getattr(self, f.name) for f in fields(self) if f.name not in _ARRAYS}
        values["focus"] = self.focus and asdict(self.focus)
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        if self.aim:
            values["aim"] = {k: v for k, v in asdict(self.aim).items() if k not in _AIM.values()}
            arrays |= {name: getattr(self.aim, field) for name, field in _AIM.items()}
        return values, {name: array for name, array in arrays.items() if array is not None}

    @staticmethod
    def unpacked(values: dict[str, Any], arrays: dict[str, np.ndarray]) -> Settled:
        """Inverse of ``packed``."""
        values = values | {name: arrays.get(name) for name in _ARRAYS}
        if values["aim"]:
            boxes: dict[str, Any] = {field: arrays[name] for name, field in _AIM.items()}
            values["aim"] = aim.Learned(**values["aim"], **boxes)
        if values["focus"]:
            centre, radius = values["focus"]["centre"], values["focus"]["radius"]
            values["focus"] = Focus(tuple(centre), radius)
        values["rare"] = tuple(values["rare"])
        return Settled(**values)
