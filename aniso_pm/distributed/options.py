"""How to use a cluster."""

from __future__ import annotations

import math
from dataclasses import dataclass


@dataclass(frozen=True)
class Options:
    """How to use a cluster.

    task_seconds  that a task should take: several passes, where they are short.
    task_limit    seconds after which a task counts as hung and is rendered elsewhere; None: ten
                  times what it should take and five minutes at least; three times and a minute
                  where another worker has nothing to do.
    patience      seconds to wait for a first worker, or for another when all are gone.
    home_every    seconds after which sums come home, at the latest.
    mixed         may LLVM and CUDA workers render the same picture?
    keep          workers that a cluster of one's own has: those that hang, or are lost, are started
                  again. 0: the cluster is that of somebody else.
    """

    task_seconds: float = 5.0
    task_limit: float | None = None
    patience: float = 30.0
    home_every: float = 30.0
    mixed: bool = False
    keep: int = 0

    def __post_init__(self):
        for name in ("task_seconds", "task_limit", "patience", "home_every"):
            value = getattr(self, name)
            if value is not None and not (0 < value < math.inf):
                raise ValueError(f"{name} is {value}; it must be a positive number of seconds")
