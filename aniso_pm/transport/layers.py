"""Layers of a picture, for denoising and compositing: which there are, and what eye paths keep for
them.

Light is split by how it came to the first gathered part (see ``receivers``) that the eye path
meets, perhaps over mirrors, glass and smooth metal:

direct    emitters that are seen, and light that reaches that part straight from an emitter.
caustic   light that reaches it over walked parts alone (glass, mirrors, metal, cut-outs).
indirect  all other light: it has met another gathered part before.

Every light path belongs to exactly one of them, so that their sum is the picture. A walked part is
chosen, or weighted, by the share g of the gathered part in the direction in which the path goes on.
With the shares of a throughput that has met no gathered part (``walked``), one (``once``) and, of
these, one with walked parts behind it (``caustic``), each vertex makes

    caustic' = once (1 − g),    once' = walked g + caustic',    walked' = walked (1 − g)

and emission at the next vertex is direct with the share walked + once − caustic.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import drjit as dr
import mitsuba as mi

from ..map.receivers import gathered_part
from .uses import Use

LIGHT = ("direct", "caustic", "indirect")
SURFACE = ("albedo", "normal", "depth", "position")
# Names of the channels of each layer, as Nuke, Blender and tev know them.
CHANNELS = {
    **dict.fromkeys(LIGHT, "RGB"),
    "albedo": "RGB",
    "normal": "XYZ",
    "depth": "Z",
    "position": "XYZ",
    "samples": "Y",
    "radius": "Y",
    "standard_error": "RGB",
    "denoising_picture": "RGB",
    "denoising_albedo": "RGB",
    "denoising_normal": "XYZ",
    "denoising_error": "RGB",
    "denoised": "RGB",
}
# What can be asked for.
NAMES = (*LIGHT, *SURFACE, "samples", "radius", "standard_error", "denoising")


def parse(text: str) -> tuple[str, ...]:
    """The layers that a text "albedo, normal" names, in the order of NAMES. Raises ValueError."""
    asked = [name.strip() for name in text.split(",") if name.strip()]
    for name in asked:
        if name not in NAMES:
            raise ValueError(
                f'aniso_pm: parameter "layers" is "{text}", but there is no layer "{name}"; it '
                f"must be names out of {', '.join(NAMES)}, separated by commas"
            )
    return tuple(name for name in NAMES if name in asked)


@dataclass
class Light:
    """Radiance (W/m²/sr) by how it came."""

    direct: Any
    caustic: Any
    indirect: Any


@dataclass
class Surface:
    """What an eye path has seen.

    albedo    directional albedo where the path has met its first receiver, times its throughput up
              to there; an estimate that is exact where all receivers are diffuse.
    normal    shading normal there, towards the viewer. Without a receiver both are those of the
              first surface.
    depth     length of the path (world units) from the camera to the first surface.
    position  of the first surface (world units).
    """

    albedo: Any
    normal: Any
    depth: Any
    position: Any


@dataclass
class Trail:
    """What an eye path keeps for the layers that somebody asks for, one lane a path.

    light, surface  None where nobody asks.
    walked, once, caustic  shares of the throughput, see above.
    fresh  has the path not met a surface yet?  unsettled: nor a receiver?
    """

    light: Light | None
    surface: Surface | None
    walked: Any
    once: Any
    caustic: Any
    fresh: Any
    unsettled: Any

    def emission(self, value, active):
        """Emission found at a vertex, weighted."""
        if self.light is None:
            return
        self.light.direct[active] += value * (self.walked + self.once - self.caustic)
        self.light.caustic[active] += value * self.caustic
        self.light.indirect[active] += value * (1 - self.walked - self.once)

    def direct_light(self, use: Use, bsdf, si, wo, value, f, roughness, scattered, active):
        """Light by emitter sampling at a vertex: ``value`` in all, with the BSDF's value f.

        use, scattered  of the walk (see ``uses``): where paths go on with one part of a BSDF, a
                        part that has not been chosen is not there.
        """
        if self.light is None:
            return
        if use != "none":
            self.light.direct[active & ~scattered] += value
            self.light.indirect[active & scattered] += value
            return
        g = gathered_part(bsdf, si, wo, roughness, active)
        gathered = value * dr.select(f > 0, dr.clip(g / f, 0, 1), 0)
        self.light.direct[active] += value * self.walked
        self.light.caustic[active] += self.once * (value - gathered)
        self.light.indirect[active] += self.once * gathered + (1 - self.walked - self.once) * value

    def scatter(self, use: Use, g, scattered):
        """The path goes on. g: share of the gathered part; ``scattered`` as it was so far."""
        if self.light is None:
            return
        if use == "none":
            self.caustic = self.once * (1 - g)
            self.once = self.walked * g + self.caustic
            self.walked = self.walked * (1 - g)
        elif use != "global":
            self.walked = dr.select(scattered, mi.Spectrum(0), mi.Spectrum(1))

    def see(self, si, albedo, distance, is_receiver, active):
        """A surface that is not null. albedo: throughput of the path that leaves it, were it not
        for shares of gathered parts; distance: from the camera."""
        if self.surface is None:
            return
        s = self.surface
        first = active & self.fresh
        s.depth[first] = distance
        s.position[first] = mi.Vector3f(si.p)
        here = active & self.unsettled & (self.fresh | is_receiver)
        s.albedo[here] = albedo
        n = mi.Vector3f(si.sh_frame.n)
        s.normal[here] = dr.mulsign(n, mi.Frame3f.cos_theta(si.wi))
        self.fresh &= ~active
        self.unsettled &= ~(active & is_receiver)


def begin(light: bool, surface: bool) -> Trail | None:
    """Of paths that leave the camera; None where nobody asks for anything."""
    if not light and not surface:
        return None
    black = lambda: mi.Spectrum(0)  # noqa: E731
    return Trail(
        Light(black(), black(), black()) if light else None,
        Surface(black(), mi.Vector3f(0), mi.Float(0), mi.Vector3f(0)) if surface else None,
        mi.Spectrum(1),
        mi.Spectrum(0),
        mi.Spectrum(0),
        mi.Bool(True),
        mi.Bool(True),
    )


@dataclass
class Seen:
    """What the eye paths of a wavefront saw: radiance (W/m²/sr), and what they kept."""

    radiance: Any
    light: Light | None
    surface: Surface | None
