"""One pixel explained: its eye paths, and the kernel that one of them reads the photon map with.

``explain`` traces eye paths through a pixel with the integrator's own code, against the photons of
the pass that is asked for, and looks closely at one gather point: the lobe that arrives there, the
kernel that the rule and the guard make of it, and the photons inside. ``aniso-pm explain`` prints
and draws the result; in a notebook the value of the function shows itself.
"""

from __future__ import annotations

from .explanation import Explanation
from .pixel import explain
from .record import Facts, Kernel, Lobe, Photons, Vertex

__all__ = ["Explanation", "Facts", "Kernel", "Lobe", "Photons", "Vertex", "explain"]
