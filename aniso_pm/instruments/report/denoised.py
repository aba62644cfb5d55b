"""What denoising needs beside the pictures of Mitsuba's integrators: a film with a box filter, and
albedo and normal by Mitsuba's ``aov``."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from aniso_pm.pictures import denoising

_AOVS = "albedo:albedo,normal:sh_normal"


def boxed(file: Path, defines: Mapping[str, str]):
    """The scene of an XML file, with a box filter in each of its films."""
    config = mi.parser.ParserConfig(mi.variant())
    config.merge_equivalent = config.merge_meshes = False
    state = mi.parser.parse_file(config, str(file), **defines)
    mi.parser.transform_all(config, state)
    for film in [node for node in state.nodes if node.type == mi.ObjectType.Film]:
        for name, value in list(film.props.items()):
            if isinstance(value, mi.Properties.ResolvedReference):
                if state.nodes[value.index()].type == mi.ObjectType.ReconstructionFilter:
                    del film.props[name]
        box = mi.parser.SceneNode()
        box.type, box.props = mi.ObjectType.ReconstructionFilter, mi.Properties("box")
        state.nodes.append(box)
        film.props["rfilter"] = mi.Properties.ResolvedReference(len(state.nodes) - 1)
    # As ``mi.load_file`` does: textures and meshes lie beside the scene's file.
    before = mi.file_resolver()
    beside = mi.FileResolver(before)
    beside.prepend(str(Path(file).resolve().parent))
    mi.set_file_resolver(beside)
    try:
        found = mi.parser.instantiate(config, state)
    finally:
        mi.set_file_resolver(before)
    return found[0] if isinstance(found, list) else found


def with_aovs(plugin: Mapping[str, Any]) -> tuple[Any, bool]:
    """An integrator that also gives albedo and normal, and whether it does: those that start at the
    lights, and those that Mitsuba writes in Python, do not."""
    made = mi.load_dict(dict(plugin))
    if isinstance(made, mi.CppADIntegrator) or not isinstance(made, mi.SamplingIntegrator):
        return made, False
    return mi.load_dict({"type": "aov", "aovs": _AOVS, "nested": made}), True


class Calls:
    """The mean of the pictures of several calls, and the layers of ``denoising`` beside it.

    weights  of the film's own filter over whole pixels, which is applied last (see
             ``film.pixel_weights``).
    aovs     the last six channels of a picture are albedo and normal.
    """

    def __init__(self, weights, aovs: bool):
        self._weights, self._aovs = np.array(weights), aovs
        self._sum: Any = 0.0
        self._spp = 0

    def add(self, image: np.ndarray, spp: int) -> None:
        """A picture of ``spp`` samples a pixel: height × width × 3 channels or more."""
        self._sum = self._sum + spp * image
        self._spp += spp

    @property
    def layers(self) -> dict[str, np.ndarray]:
        """As an ``aniso_pm`` has them with ``layers=denoising``, but for the error of each pixel:
        the spread of calls of different size says little of it, and blending by it made the
        denoised error of ``path`` up to 2.7 times as large."""
        mean = self._sum / self._spp
        colour = mean[..., :3]
        found = {"denoising_picture": colour, "denoising_filter": self._weights}
        if self._aovs:
            found["denoising_albedo"], found["denoising_normal"] = mean[..., -6:-3], mean[..., -3:]
        return found

    @property
    def picture(self) -> np.ndarray:
        """The mean, with the film's own filter."""
        return denoising.filtered_by((self._sum / self._spp)[..., :3], self._weights)
