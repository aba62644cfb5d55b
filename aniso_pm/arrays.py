"""Numbers and NumPy arrays into Dr.Jit's memory."""

from __future__ import annotations

import drjit as dr
import numpy as np

# Multiples of what any machine reads at once: numbers, bytes.
_LANES, _ALIGNED = 64, 64


def own(kind, values: np.ndarray):
    """``values``, flattened, as a Dr.Jit array (``mi.Float``, ``mi.UInt32``) in its own memory.

    ``kind(values)`` uses NumPy's memory as it lies. The LLVM backend (Dr.Jit 1.5) reads whole
    vectors from it, up to 60 bytes beyond its end, which ends the process where the next page is
    not mapped; and where memory is not aligned its kernels are others, compiled beside those for
    memory that is. So the values first go where a multiple of _LANES of them is aligned.
    """
    count, size = values.size, values.dtype.itemsize
    room = -(-max(count, 1) // _LANES) * _LANES * size
    memory = np.zeros(room + _ALIGNED, np.uint8)
    start = -memory.ctypes.data % _ALIGNED
    padded = memory[start : start + room].view(values.dtype)
    padded[:count] = values.ravel()
    array = kind(padded) + dr.opaque(kind, 0)
    dr.eval(array)
    return dr.reshape(kind, array, count, shrink=True)


def room(kind, count: int):
    """Memory for ``count`` entries (a Dr.Jit type), which are not written yet. What is frozen is
    replayed for any number of them, but traced anew for every size of a ``dr.empty``."""
    memory = dr.empty(kind, count)
    dr.make_opaque(memory)
    return memory


def number(kind, value):
    """A number as an array that is no literal: as a literal it would be compiled into kernels, a
    new one for every value. Arrays stay what they are."""
    return kind(value) if dr.is_array_v(value) else dr.opaque(kind, value)
