"""A working LLVM for Dr.Jit: found before Dr.Jit loads, refused readably where it is too late.

Dr.Jit opens LLVM while it is imported: the library that ``DRJIT_LIBLLVM_PATH`` names, else the
first ``libLLVM`` of the system. With LLVM 15 and 16 Dr.Jit 1.5 aborts the process at the first
kernel (``Cannot select … fminimum``), and it declines 14. The PyPI package ``karellen-llvm-core``
brings a library that works, so :func:`prepare` names that one unless the user has named another.
Once Dr.Jit is loaded nothing can be changed any more; then all that is left is to say so.
"""

from __future__ import annotations

import os
import re
import site
import sys
import warnings
from importlib import metadata
from pathlib import Path

VARIABLE = "DRJIT_LIBLLVM_PATH"
MINIMUM = 17  # First major version whose code generator knows all that Dr.Jit 1.5 emits
PACKAGE = "karellen-llvm-core"


def find_library() -> Path | None:
    """The newest usable libLLVM that the ``karellen-llvm-core`` package installed, or None."""
    usable: dict[tuple[int, int], Path] = {}
    for path in _candidates():
        # Links carry no version ("libLLVM.so"); the files they lead to do ("libLLVM.so.23.1").
        path = path.resolve()
        version = re.search(r"libLLVM(?:-|\.so\.)(\d+)(?:\.(\d+))?", path.name)
        if version and int(version[1]) >= MINIMUM and path.is_file():
            usable.setdefault((int(version[1]), int(version[2] or 0)), path)
    return usable[max(usable)] if usable else None


def _candidates():
    # Ask the package itself first: its record also holds in user and relocated installs.
    try:
        package = metadata.distribution(PACKAGE)
    except metadata.PackageNotFoundError:
        folders = []
    else:
        for file in package.files or ():
            if file.name.startswith("libLLVM"):
                yield Path(str(package.locate_file(file)))
        folders = [Path(str(package.locate_file("lib")))]  # where `pip install --target` puts it

    folders += [Path(sys.prefix) / "lib", Path(site.getuserbase()) / "lib"]
    for folder in folders:
        yield from sorted(folder.glob("libLLVM*.so*"))


def loaded_version() -> tuple[int, int, int] | None:
    """Version of the LLVM that Dr.Jit holds; None if it holds none. Imports Dr.Jit."""
    import drjit as dr

    version = tuple(dr.detail.llvm_version())
    return version if version[0] > 0 else None


def prepare() -> None:
    """Load Dr.Jit with a working LLVM, or say why that cannot be.

    Raises ImportError where Dr.Jit holds an LLVM that would abort the process, or where the
    library named by ``DRJIT_LIBLLVM_PATH`` cannot be used. An active ``scalar_*`` or ``cuda_*``
    variant needs no LLVM: then the same error comes when an ``llvm_*`` variant is chosen. So it
    does in the command line program, whose ``doctor`` has to be able to start and explain.
    """
    too_late = "drjit" in sys.modules
    if not too_late and not os.environ.get(VARIABLE) and (library := find_library()):
        os.environ[VARIABLE] = str(library)

    trouble = explain(too_late)
    if trouble is None:
        return

    import mitsuba as mi

    needs_no_llvm = mi.variant() and not mi.variant().startswith("llvm_")
    is_command = Path(next(iter(sys.argv), "")).stem == "aniso-pm"
    if needs_no_llvm or is_command:
        _refuse_llvm_variants(trouble)
    elif loaded_version() or (os.environ.get(VARIABLE) and not too_late):
        raise ImportError(trouble)
    else:
        # Nothing can abort: Dr.Jit holds no LLVM at all, and other variants may be wanted.
        warnings.warn(trouble, RuntimeWarning, stacklevel=3)


def explain(too_late: bool = False) -> str | None:
    """What is wrong with the LLVM that Dr.Jit holds and how to mend it; None if it will do.

    ``too_late`` says that Dr.Jit had been imported before this package could choose.
    """
    version = loaded_version()
    if version and version[0] >= MINIMUM:
        return None

    named = os.environ.get(VARIABLE)
    library = find_library()
    held = f"LLVM {'.'.join(map(str, version))}" if version else "no usable LLVM"
    if named and not Path(named).is_file() and os.sep in named:
        reason = f"{VARIABLE} names the file '{named}', which does not exist"
    elif named:
        reason = f"Dr.Jit has loaded {held} with {VARIABLE}='{named}'; {MINIMUM} or newer is needed"
    else:
        reason = f"Dr.Jit has loaded {held}; {MINIMUM} or newer is needed"
        reason += " (older ones abort the process)" if version else " for the llvm_* variants"

    remedies = []
    if library and (named or too_late):
        unset = [f"unset {VARIABLE}"] if named else []
        first = ["import aniso_pm before drjit and mitsuba"] if too_late else []
        remedies.append(" and ".join(unset + first))
    remedies.append(
        f"set {VARIABLE}={library or f'<path of a libLLVM of version {MINIMUM} or newer>'} "
        "in the environment before Python starts"
    )
    return f"{reason}. To mend it, {', or '.join(remedies)}."


_refusing = False


def _refuse_llvm_variants(trouble: str) -> None:
    import mitsuba as mi

    def refuse(old: str | None, new: str) -> None:
        if new.startswith("llvm_"):
            # Mitsuba keeps the new variant when a callback raises: leave it first.
            if old:
                mi.set_variant(old)
            raise ImportError(trouble)

    # Mitsuba 3.10 reloads plugin packages at every change of variant: listen once only.
    global _refusing
    if not _refusing:
        mi.detail.add_variant_callback(refuse)
        _refusing = True
