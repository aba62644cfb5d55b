"""The kernels that Dr.Jit compiles and launches for a piece of work."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import drjit as dr


@contextmanager
def recorded() -> Iterator[Callable[[], list[dict[str, Any]]]]:
    """Keep Dr.Jit's kernel history. Gives a function that returns the records of the compiled
    kernels (no reductions, no sorts) launched since its last call."""
    before = dr.flag(dr.JitFlag.KernelHistory)
    dr.sync_thread()
    dr.kernel_history_clear()
    dr.set_flag(dr.JitFlag.KernelHistory, True)

    def records() -> list[dict[str, Any]]:
        dr.sync_thread()
        return [k for k in dr.kernel_history() if k["type"] == dr.KernelType.JIT]

    try:
        yield records
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, before)
