"""What is compared: names on the command line → integrators with parameters.

``aniso_pm`` is this package's photon mapper as installed: nothing is set but the scene's limits of
path length. ``isotropic``, ``lobe``, ``taylor`` and ``paper`` are the same with that kernel, and
with passes of a given size so that kernels alone differ, each twice: at its default bandwidth,
which a pilot chooses in each rendering, and at its own best one, which a sweep over other seeds has
found. ``NAME/default`` and ``NAME/best`` name one of the two. Every other name is one of Mitsuba's
integrators, perhaps with parameters: ``path:max_depth=8,rr_depth=16``.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any

from aniso_pm.errors import InputError
from aniso_pm.kernel import RULES

INSTALLED, ISOTROPIC, PATH = "aniso_pm", "isotropic", "path"
KERNELS = (ISOTROPIC, *RULES)
BANDWIDTHS = ("default", "best")
STANDARD = (INSTALLED, ISOTROPIC, "lobe", "taylor", "paper", PATH, "ptracer")
QUICK = (INSTALLED, ISOTROPIC, "lobe", PATH)
# At the end of the names and labels of denoised methods.
DENOISED = ", denoised"


@dataclass(frozen=True)
class Method:
    """One curve of the report.

    name        as in the results: "lobe/best", "path:max_depth=8".
    plugin      type and parameters of the integrator that differ from the scene's own.
    bandwidth   "default", "best", "installed" (with all else by default), or None where there are
                no kernels.
    denoised    what is measured is its denoised picture.
    """

    name: str
    plugin: dict[str, Any]
    bandwidth: str | None = None
    denoised: bool = False

    def with_denoising(self) -> Method:
        """This method with its pictures denoised."""
        return replace(self, name=self.name + DENOISED, denoised=True)

    @property
    def ours(self) -> bool:
        return self.bandwidth is not None

    @property
    def installed(self) -> bool:
        return self.bandwidth == "installed"

    @property
    def kernel(self) -> str:
        """ "isotropic", or the rule; the plugin's name as installed and for Mitsuba's."""
        return self.name.partition("/")[0].removesuffix(DENOISED)

    @property
    def label(self) -> str:
        if self.installed:
            return f"as installed{DENOISED * self.denoised}"
        if not self.ours:
            return self.name
        return f"{self.kernel}, {self.bandwidth} bandwidth" + DENOISED * self.denoised

    @property
    def slug(self) -> str:
        """The name as part of a file's name."""
        return "".join(c if c.isalnum() or c in "-=." else "_" for c in self.name)


def parse(name: str) -> list[Method]:
    """The methods that a name stands for. Raises InputError for one that stands for none."""
    if name == INSTALLED:
        return [Method(INSTALLED, {"type": INSTALLED}, "installed")]
    kernel, slash, bandwidth = name.partition("/")
    if kernel in KERNELS:
        if slash and bandwidth not in BANDWIDTHS:
            raise InputError(
                f"method '{name}': after '{kernel}/' comes one of {', '.join(BANDWIDTHS)}"
            )
        return [_ours(kernel, b) for b in ([bandwidth] if slash else BANDWIDTHS)]
    return [_mitsubas(name)]


def parse_all(names) -> list[Method]:
    """The methods that several names stand for, each once, in their order."""
    return list({method.name: method for name in names for method in parse(name)}.values())


def _ours(kernel: str, bandwidth: str) -> Method:
    plugin: dict[str, Any] = {"type": "aniso_pm", "kernel": "isotropic"}
    if kernel != ISOTROPIC:
        plugin |= {"kernel": "anisotropic", "rule": kernel}
    return Method(f"{kernel}/{bandwidth}", plugin, bandwidth)


def _mitsubas(name: str) -> Method:
    import mitsuba as mi

    kind, _, rest = name.partition(":")
    plugin: dict[str, Any] = {"type": kind}
    for pair in filter(None, rest.split(",")):
        key, equals, value = pair.partition("=")
        if not key or not equals:
            raise InputError(f"method '{name}': after '{kind}:' comes KEY=VALUE,…, not '{pair}'")
        plugin[key] = _value(value)
    if kind == INSTALLED:
        raise InputError(
            f"method '{name}': {INSTALLED} is as installed, without parameters; else name a "
            f"kernel, one of {', '.join(KERNELS)}"
        )
    try:
        made = mi.load_dict(plugin)
    except Exception as error:
        raise InputError(
            f"method '{name}' is none of {', '.join((INSTALLED, *KERNELS))}, and Mitsuba cannot "
            f"make an integrator of it: {error}"
        ) from error
    if not isinstance(made, mi.Integrator):
        raise InputError(f"method '{name}': Mitsuba's '{kind}' is not an integrator")
    return Method(name, plugin)


def _value(text: str) -> bool | int | float | str:
    if text in ("true", "false"):
        return text == "true"
    for kind in (int, float):
        try:
            value = kind(text)
        except ValueError:
            continue
        if math.isfinite(value):
            return value
    return text
