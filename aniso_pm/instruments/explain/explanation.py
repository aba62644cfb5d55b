"""What was found about a pixel, as people look at it."""

from __future__ import annotations

import html
from dataclasses import dataclass

from . import plot
from .record import Facts
from .text import as_text


@dataclass(frozen=True)
class Explanation(Facts):
    """What ``explain`` has found; the fields are those of ``Facts``. ``str()`` says it in words,
    ``plot()`` draws it, a notebook shows both."""

    def __str__(self) -> str:
        return as_text(self)

    def plot(self):
        """A matplotlib figure: the lobe, and the receiver's plane with photons and kernel.

        Raises ValueError where there is no kernel to draw; ImportError without matplotlib.
        """
        return plot.figure(self)

    def _repr_html_(self) -> str:
        words = f'<pre style="font-family: monospace">{html.escape(str(self))}</pre>'
        return words if self.kernel is None else words + plot.as_svg(self)
