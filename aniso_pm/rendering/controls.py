"""What a caller may want of a rendering in passes, and what is left of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from .prepared import Prepared
from .settled import Settled
from .state import Checkpoint

if TYPE_CHECKING:
    from .progressive import Run


@dataclass
class Controls:
    """What a caller may want besides the picture.

    first_pass  number of the first pass.
    progress    called as progress(done, total, text) after every wavefront: passes, which may be
                fractions; total is None where nobody knows.
    callback    called as callback(pass_index, image, statistics) after every pass: the picture so
                far as a tensor, and the statistics so far.
    checkpoint  where to keep the state.
    so_far      called as so_far(variance, layers, passes), as in ``Rendered``, before somebody else
                looks at the picture so far.
    settled     what a pilot has chosen, on another machine; None: one will choose here.
    spread      is the spread of passes kept, where there are several?
    elsewhere   who renders the passes, if not this process: called with the ``Run``, gives them to
                its ``add``. progress and callback are then called after each of those.
    """

    first_pass: int = 0
    progress: Callable[[float, int | None, str], None] | None = None
    callback: Callable[[int, Any, dict], None] | None = None
    checkpoint: Checkpoint | None = None
    so_far: Callable[[Any, Any, int], None] | None = None
    settled: Settled | None = None
    spread: bool = True
    elsewhere: Callable[[Run], None] | None = None

    def __post_init__(self):
        if self.first_pass < 0:
            raise ValueError(
                f"aniso_pm: first_pass is {self.first_pass}; passes are counted from 0"
            )


@dataclass
class Rendered:
    """What is left of a rendering beside the film: the scene with what was chosen for it, map and
    radius of the last pass (None if no pass was rendered), variance of the picture (None with one
    pass), sums of the layers that were asked for (see ``layered``; None: none were) over so many
    passes."""

    scene: Prepared
    map: Any
    radius: float | None
    variance: np.ndarray | None
    layers: dict[str, np.ndarray] | None
    passes: int
