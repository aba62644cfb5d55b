"""Photon mapping with anisotropic density estimation, as plugins of Mitsuba 3.

Importing this package registers the integrator ``aniso_pm``, the BSDF ``asgconductor`` and the
sampler ``owen_sobol`` for the current Mitsuba variant and every later one. Import it before
``drjit`` and ``mitsuba``: it then also provides an LLVM that Dr.Jit can use (see
:mod:`aniso_pm._llvm`).

The mathematics is usable by itself: :mod:`aniso_pm.asg` (anisotropic spherical Gaussians),
:mod:`aniso_pm.ndf` (roughness to ASG), :mod:`aniso_pm.warp` (half-vector to reflection) and
:mod:`aniso_pm.kernel` (elliptical kernels).
"""

import sys
from pathlib import Path

from aniso_pm import _llvm
from aniso_pm._version import __version__

# In a clone plugins/ and scenes/ lie beside this folder. Python started there finds this folder
# before the installed package, which has them inside.
if not (Path(__file__).parent / "plugins").is_dir():
    __path__.append(str(Path(__file__).parent.parent))

_llvm.prepare()

# Dr.Jit must load after LLVM.
import drjit  # noqa: E402

# With a single thread, as on a single core, Mitsuba waits for ever where it reads or writes EXR.
if drjit.thread_count() < 2:
    drjit.set_thread_count(2)

from aniso_pm import asg, kernel, ndf, plugins, warp  # noqa: E402
from aniso_pm.pictures.denoising import denoise  # noqa: E402
from aniso_pm.rendering import progress, state  # noqa: E402

plugins.register()

# Importable by the names under which they are public.
sys.modules.update({f"{__name__}.progress": progress, f"{__name__}.state": state})

__all__ = ["__version__", "asg", "denoise", "kernel", "ndf", "progress", "state", "warp"]
