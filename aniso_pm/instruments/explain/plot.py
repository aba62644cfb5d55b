"""An explanation as a picture: the lobe with the kernel as seen from p0, and the receiver's plane.

Both panels have equal scales on both axes, so that shapes are true.
"""

from __future__ import annotations

import io

import numpy as np

from ...map.density import CUT2
from .record import Facts, Lobe

# Where the kernel ends, in half axes.
_CUT = CUT2**0.5
# Colour-blind safe: blue kernel, vermilion photons, green lobe.
_KERNEL, _PHOTON, _LOBE, _MUTED = "#0072b2", "#d55e00", "#009e73", "0.55"


def figure(found: Facts):
    """See ``explanation.Explanation.plot``."""
    from matplotlib.figure import Figure

    if found.kernel is None:
        raise ValueError(f"pixel {found.pixel[0]},{found.pixel[1]}: {found.sentence}")
    lobe = found.lobe if found.kernel.follows_lobe else None
    drawing = Figure(figsize=(11 if lobe else 6.5, 6.6), layout="constrained")
    panels = drawing.subplots(1, 2 if lobe else 1, squeeze=False)[0]
    if lobe:
        _draw_lobe(panels[0], lobe, found.outlines["seen from p0"])
    _draw_plane(panels[-1], found)
    title = f"pixel {found.pixel[0]},{found.pixel[1]}, eye path {found.sample}\n{found.sentence}"
    drawing.suptitle(title, fontsize="medium")
    return drawing


def as_svg(found: Facts) -> str:
    text = io.StringIO()
    figure(found).savefig(text, format="svg", bbox_inches="tight")
    return text.getvalue()[text.getvalue().index("<svg") :]


def _draw_lobe(axes, lobe: Lobe, kernel):
    """G over the directions around its centre, and what the kernel covers of it."""
    r = np.array(lobe.r)
    at = np.array([r @ np.array(lobe.x), r @ np.array(lobe.y)])
    sigma = np.radians(lobe.sigma)
    reach = max(3 * sigma.max(), 1.15 * np.abs(np.vstack([kernel, at])).max())
    reach = min(reach, 1.0)
    a = np.linspace(-reach, reach, 301)
    a, b = np.meshgrid(a, a)
    height2 = np.maximum(1 - a**2 - b**2, 0)
    value = np.sqrt(height2) * np.exp(-lobe.lam * a**2 - lobe.mu * b**2)
    axes.contourf(
        a, b, value, levels=[0.01, 0.1, np.exp(-1), 0.7, 0.9, 1], cmap="Greens", alpha=0.8
    )
    axes.contour(a, b, value, levels=[np.exp(-1)], colors=_LOBE)
    axes.plot([], [], color=_LOBE, label="lobe, 1/e")
    axes.plot(*kernel.T, color=_KERNEL, lw=2, label="kernel as seen from p0, 1/e")
    axes.plot(*at, "k+", ms=10, label="r")
    axes.set(title="The lobe at p0", xlabel="v·x", ylabel="v·y", aspect="equal")
    _legend(axes)


def _draw_plane(axes, found: Facts):
    """Photons and kernel in the receiver's tangent plane."""
    photons, kernel, lines = found.photons, found.kernel, found.outlines
    assert photons is not None and kernel is not None
    elsewhere = ~photons.facing
    axes.plot(*photons.xy[elsewhere].T, "x", ms=3, color="0.85", label="photons on other surfaces")
    outside = photons.facing & ~photons.counted
    axes.plot(*photons.xy[outside].T, ".", ms=3, color=_MUTED, label="photons outside")
    inside, total = photons.counted, found.photons_inside
    drawn = "" if inside.sum() == total else f" ({inside.sum()} drawn)"
    dots = axes.scatter(
        *photons.xy[inside].T,
        c=photons.weight[inside],
        vmin=0,
        vmax=1,
        cmap="autumn_r",
        s=14,
        zorder=3,
        edgecolors=_PHOTON,
        linewidths=0.6,
        label=f"{total} photons inside{drawn}",
    )
    axes.figure.colorbar(dots, ax=axes, label="kernel weight", shrink=0.7)
    outline = lines["kernel"]
    axes.plot(*outline.T, color=_KERNEL, lw=2, label="kernel, 1/e")
    axes.plot(*(_CUT * outline).T, color=_KERNEL, lw=1, label="kernel, cut")
    if kernel.follows_lobe:
        axes.plot(*lines["disc"].T, color="k", lw=1, ls="--", label="disc of that bandwidth, 1/e")
        axes.plot(*lines["unguarded"].T, color=_KERNEL, lw=1, ls=":", label="without guard, 1/e")
        axes.plot(*lines["footprint"].T, color=_LOBE, lw=1, ls="-.", label="lobe's footprint, 1/e")
    reach = 1.15 * np.abs(_CUT * outline).max()
    axes.set(xlim=(-reach, reach), ylim=(-reach, reach), aspect="equal")
    axes.set(title="The receiver's plane at p1", xlabel="along s", ylabel="along t")
    _legend(axes)


def _legend(axes):
    # Below: over the photons it would hide what it explains.
    axes.legend(
        loc="upper center", bbox_to_anchor=(0.5, -0.12), ncol=2, fontsize="small", frameon=False
    )
