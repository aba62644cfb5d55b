"""Numbers out of spectra."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi


def channel_mean(spectrum):
    """Mean over the channels of each lane. ``dr.mean`` says the same, but with the number of lanes
    as a literal in its code (Dr.Jit 1.5), so that every wavefront of another size would compile
    kernels of its own."""
    return dr.sum(spectrum) * (1 / dr.size_v(mi.Spectrum))
