"""What this installation consists of, whether it works, and how to mend what does not.

Each finding is a :class:`Check`. Kernels are run in a process of their own, because an LLVM that
Dr.Jit cannot use aborts the process instead of raising an exception.
"""

from __future__ import annotations

import json
import os
import platform
import subprocess
import sys
from dataclasses import asdict, dataclass
from importlib import metadata

from aniso_pm import _llvm
from aniso_pm._version import __version__
from aniso_pm.errors import one_line

# Runs one kernel, then makes the integrator; each step says that it was reached.
_SELF_TEST = """
import sys
import aniso_pm
import mitsuba as mi
mi.set_variant(sys.argv[1])
scene = mi.load_dict({'type': 'scene', 'shape': {'type': 'rectangle'}})
ray = mi.Ray3f(mi.Point3f(mi.Float([0, 9]), 0, 1), mi.Vector3f(0, 0, -1))
assert [bool(hit) for hit in scene.ray_intersect(ray).is_valid()] == [True, False]
print('kernel', flush=True)
mi.load_dict({'type': 'aniso_pm'})
print('plugin', flush=True)
"""


@dataclass(frozen=True)
class Check:
    """One finding: ``fix`` is what to do about it, and None where all is well."""

    name: str
    value: str
    fix: str | None = None


def versions() -> dict[str, str]:
    """Versions of everything that a rendered picture depends on, by name."""
    import drjit as dr
    import mitsuba as mi

    llvm = _llvm.loaded_version()
    return {
        "aniso_pm": __version__,
        "mitsuba": mi.__version__,
        "drjit": dr.__version__,
        "llvm": ".".join(map(str, llvm)) if llvm else "none",
        "python": platform.python_version(),
    }


def examine() -> list[Check]:
    """Look at everything; takes some seconds for the self-test."""
    import drjit as dr
    import mitsuba as mi

    found = versions()
    checks = [Check(name, version) for name, version in found.items() if name != "llvm"]
    for package in ("numpy", "OpenEXR"):
        try:
            checks.append(Check(package, metadata.version(package)))
        except metadata.PackageNotFoundError:
            checks.append(Check(package, "missing", f"pip install {package}"))

    trouble = _llvm.explain()
    library = os.environ.get(_llvm.VARIABLE) or "the system's own"
    checks.append(Check("LLVM", f"{found['llvm']} ({library})", trouble))

    cuda = bool(dr.has_backend(dr.JitBackend.CUDA))
    device = ".".join(map(str, dr.detail.cuda_version())) if cuda else "no device or driver"
    checks.append(Check("CUDA", device))
    backends = ("llvm_", "cuda_") if cuda else ("llvm_",)
    usable = [v for v in mi.variants() if v.startswith(backends) and "polarized" not in v]
    checks.append(Check("variants", ", ".join(usable) or "none that this integrator can use"))
    checks.append(Check("cores", f"{os.cpu_count()}, {dr.thread_count()} threads used by Dr.Jit"))

    for variant in ["llvm_ad_rgb"] + ["cuda_ad_rgb"] * cuda:
        checks += _self_test(variant, llvm_is_wrong=bool(trouble) and variant.startswith("llvm_"))
    return checks


def _self_test(variant: str, llvm_is_wrong: bool) -> list[Check]:
    command = [sys.executable, "-c", _SELF_TEST, variant]
    try:
        run = subprocess.run(command, capture_output=True, text=True, timeout=300)
    except subprocess.TimeoutExpired:
        return [Check(f"kernel {variant}", "no answer in 300 s", "look at the machine's load")]

    lines = [line.strip() for line in run.stderr.splitlines() if line.strip()]
    if run.returncode < 0:
        lines.append(f"the process ended with signal {-run.returncode}")
    error = one_line(lines[-1]) if lines else f"exit status {run.returncode}"
    if llvm_is_wrong:
        error, fix = "does not start", "mend LLVM, above"
    else:
        fix = "reinstall, in your clone: pip install --force-reinstall ."
        if variant.startswith("cuda"):
            fix += " (in a container, OptiX needs NVIDIA_DRIVER_CAPABILITIES=all)"

    reached = run.stdout.split()
    return [
        Check(f"{step} {variant}", well)
        if step in reached
        else Check(f"{step} {variant}", error, fix)
        for step, well in (("kernel", "runs"), ("plugin", "registers"))
    ]


def as_json(checks: list[Check]) -> str:
    """All findings as one JSON object with ``ok`` and ``checks``."""
    well = all(check.fix is None for check in checks)
    return json.dumps({"ok": well, "checks": [asdict(check) for check in checks]}, indent=2)


def as_text(checks: list[Check]) -> str:
    """All findings as a table, with the fix below each thing that is wrong."""
    width = max(len(check.name) for check in checks)
    lines = []
    for check in checks:
        lines.append(f"{'✗' if check.fix else '✓'} {check.name:<{width}}  {check.value}")
        if check.fix:
            lines.append(f"  {'':<{width}}  fix: {check.fix}")
    return "\n".join(lines)
