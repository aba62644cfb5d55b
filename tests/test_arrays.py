"""NumPy memory that ends where the next page is not mapped."""

import subprocess
import sys

import aniso_pm  # noqa: F401
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.arrays import own

GUARDED = """
import ctypes, mmap, sys
import aniso_pm, drjit as dr, mitsuba as mi, numpy as np
from aniso_pm.arrays import own
mi.set_variant("llvm_ad_rgb")
page = mmap.PAGESIZE
memory = mmap.mmap(-1, 3 * page)
address = ctypes.addressof(ctypes.c_char.from_buffer(memory))
# The last page may not be touched; the array ends where it begins, and is 16 lanes long and one.
assert ctypes.CDLL(None).mprotect(ctypes.c_void_p(address + 2 * page), page, 0) == 0
count = 33
values = np.frombuffer(memory, np.float32, count, 2 * page - 4 * count)
values[:] = np.arange(count)
array = own(mi.Float, values) if sys.argv[1] == "own" else mi.Float(values)
found = array + dr.opaque(mi.Float, 1)
assert (found.numpy() == np.arange(count) + 1).all()
print("read")
"""


def read(how):
    command = [sys.executable, "-c", GUARDED, how]
    return subprocess.run(command, capture_output=True, text=True)


def test_nothing_beyond_the_end_of_an_array_is_read():
    done = read("own")
    assert done.stdout.strip() == "read", done.stderr


@pytest.mark.parametrize("kind, dtype", [("Float", np.float32), ("UInt32", np.uint32)])
def test_values_are_kept(variants_all, kind, dtype):
    values = np.arange(35).reshape(5, 7).astype(dtype)
    np.testing.assert_array_equal(own(getattr(mi, kind), values.T).numpy(), values.T.ravel())
