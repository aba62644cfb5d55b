"""How much memory a rendering takes, and wavefronts small enough for what there is.

The estimate is a sum of bytes per thing: Dr.Jit keeps what is freed for arrays of the same size,
so that stages add up rather than take turns. The figures were measured as growth of the process's
resident memory over rooms of 1e5 to 1e7 stored photons and 1e6 to 4e6 eye samples (``llvm_ad_rgb``;
``tests/test_memory.py`` measures again). Fluxes of more bytes count on top.

What is fixed is the film and the map. What is in flight is split into wavefronts: they are halved
until all fits, light paths and eye samples down to SMALLEST. Other wavefronts draw other random
numbers, from the same distribution: nobody's memory changes what a picture converges to.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import mitsuba as mi

from ..errors import Unsupported
from ..map.photon_map import flux_bytes
from ..transport import photons
from .prepared import Prepared

GIB = 1 << 30
# Light paths and eye samples of the smallest wavefronts: below, launching takes longer than work.
SMALLEST = 1 << 14
# Share of the available memory that is taken without being asked.
_SHARE = 0.75

# --- Bytes, measured (see above) ---
_FIXED = 32 << 20  # compiled kernels
_LIGHT_PATH = 24  # in flight: random numbers, emitter sample
_PHOTON = 62  # while the index is built: buffers, sorted copies, keys (16 of them flux)
_PHOTON_SUMMED = 22  # with gather_tolerance: its share of the sums over nodes
_EYE_SAMPLE = 70  # in flight: ray, random numbers, radiance
_POINT = 100  # gather point: columns, sorted copies, result (12 of them throughput)
_POINT_LOBE = 80  # its lobe
_POINT_GENERAL = 150  # its ray and surface, where there are receivers that are not Lambertian
_FILM = 32  # a channel of a pixel: block, image, sums before and after
_FILM_VARIANCE = 110  # more, where the variance is kept: two more sums, their NumPy copies


@dataclass(frozen=True)
class Job:
    """What one rendering holds in memory.

    stored    photons of a map.
    pixels    of the film, border included.
    channels  of the film's blocks, weight included.
    variance  is the variance of the picture kept?
    samples   eye samples of the largest wavefront if nothing is split.
    """

    stored: float
    pixels: int
    channels: int
    variance: bool
    samples: int


@dataclass(frozen=True)
class Wavefronts:
    """A job in wavefronts of at most so many light paths and eye samples."""

    scene: Prepared
    job: Job
    light_paths: int
    eye_samples: int

    @property
    def parts(self) -> dict[str, float]:
        """Bytes at the peak beyond what the process holds before, by what they are for."""
        scene, job = self.scene, self.job
        flux, general = flux_bytes(), bool(scene.needs.general) or scene.glossy
        summed = scene.settings.gather_tolerance > 0
        per_photon = _PHOTON + (flux - 16) + (general + scene.glossy) * 8 + summed * _PHOTON_SUMMED
        per_point = _POINT + scene.follow_lobes * _POINT_LOBE + general * _POINT_GENERAL
        per_sample = _EYE_SAMPLE + _points_per_sample(scene) * (per_point + 2 * (flux - 16))
        paths = min(self.light_paths, scene.settings.photon_count) if scene.needs_map else 0
        return {
            "photons": job.stored * per_photon,
            "film": job.pixels * job.channels * (_FILM + job.variance * _FILM_VARIANCE),
            "light paths": paths * _LIGHT_PATH,
            "eye samples": min(self.eye_samples, job.samples) * per_sample,
            "kernels": _FIXED,
        }

    @property
    def bytes(self) -> float:
        """The sum of all parts."""
        return sum(self.parts.values())

    def with_stored(self, stored: float) -> Wavefronts:
        """The same wavefronts with that many photons."""
        return replace(self, job=replace(self.job, stored=stored))


def _points_per_sample(scene: Prepared) -> float:
    """Gather points that an eye path leaves in typical scenes."""
    if not scene.needs_map:
        return 0
    if scene.use == "caustic":
        return 6  # 4 and buffers that grew
    mixed = scene.needs.general or scene.glossy
    return 1.2 if scene.use == "final_gather" or mixed else 1


def fitting(scene: Prepared, job: Job, count_photons: Callable[[], float]) -> Wavefronts:
    """Wavefronts with which ``job`` fits into the parameter ``max_memory``.

    job            its ``stored`` is an upper bound.
    count_photons  photons of a map by measurement; called only where the bound does not fit.

    Raises Unsupported where no wavefront is small enough.
    """
    limit, said = _limit(scene.settings.max_memory)
    result = Wavefronts(scene, job, photons.WAVEFRONT, job.samples)
    if result.bytes <= limit:
        return result
    result = result.with_stored(count_photons())
    while result.bytes > limit:
        # --- Halve what takes most, as long as it may be halved ---
        parts = result.parts
        flights = {"light_paths": parts["light paths"], "eye_samples": parts["eye samples"]}
        large = [f for f in flights if flights[f] and getattr(result, f) > SMALLEST]
        if not large:
            raise Unsupported(_refusal(result, said))
        if max(large, key=lambda f: flights[f]) == "light_paths":
            result = replace(result, light_paths=_half(result.light_paths))
        else:
            result = replace(result, eye_samples=_half(result.eye_samples))
    return result


def _half(lanes: int) -> int:
    """The largest power of two below."""
    return 1 << ((lanes - 1).bit_length() - 1)


def _refusal(smallest: Wavefronts, said: str) -> str:
    job, parts = smallest.job, smallest.parts
    flights = parts["light paths"] + parts["eye samples"] + parts["kernels"]
    shown = {f"the film of {job.pixels} pixels": parts["film"], "the smallest wavefronts": flights}
    if job.stored:
        shown = {f"a map of {job.stored:.2g} photons": parts["photons"]} | shown
    each = ", ".join(f"{_gib(size)} for {what}" for what, size in shown.items())
    remedy = '"photon_count"' if parts["photons"] > parts["film"] else "the size of the film"
    return (
        f'aniso_pm: parameter "max_memory" is {said}, but rendering takes about '
        f"{_gib(smallest.bytes)} GiB ({each}); lower {remedy} or give a larger max_memory"
    )


def _gib(size: float) -> str:
    return f"{size / GIB:.2g}"


# --- What there is ---


def _limit(max_memory: float) -> tuple[float, str]:
    """(bytes that may be used, what to call them)."""
    if max_memory:
        return max_memory * GIB, f"{max_memory:g} GiB"
    share = automatic()
    return share, f"0 (automatic: {_gib(share)} GiB, three quarters of what is available)"


def automatic() -> float:
    """Bytes that may be used where nobody says how many."""
    return _SHARE * available()


def available() -> float:
    """Bytes that are free on the machine, or on the device of a CUDA variant."""
    if mi.variant().startswith("cuda"):
        return _device_memory()
    import psutil

    return min(psutil.virtual_memory().available, cgroup_available())


def cgroup_available(root: Path = Path("/")) -> float:
    """Bytes that the control groups of this process leave it (Linux, versions 1 and 2); infinite
    where there are none. Cached files count as free: they are dropped on demand."""
    free = math.inf
    try:
        groups = (root / "proc/self/cgroup").read_text().splitlines()
    except OSError:
        return free
    for line in groups:
        _, controllers, path = line.split(":", 2)
        if controllers == "":
            top = root / "sys/fs/cgroup"
            names = "memory.max", "memory.current", "inactive_file"
        elif "memory" in controllers.split(","):
            top = root / "sys/fs/cgroup/memory"
            names = "memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"
        else:
            continue
        group = top / path.lstrip("/")
        # A limit may be that of any group around this one. Inside a container the path may be one
        # that only the host knows.
        for directory in (group, *group.parents):
            if directory.is_relative_to(top):
                free = min(free, _group_available(directory, *names))
    return free


def _group_available(directory: Path, limit: str, usage: str, cached: str) -> float:
    try:
        maximum = (directory / limit).read_text().strip()
        if maximum == "max":
            return math.inf
        used = int((directory / usage).read_text())
        statistics = dict(
            line.split() for line in (directory / "memory.stat").read_text().splitlines()
        )
    except OSError:
        return math.inf
    return max(0, int(maximum) - used + int(statistics.get(cached, 0)))


def _device_memory() -> float:
    """Free bytes of the first CUDA device, Dr.Jit's own choice; infinite, with a warning, if
    the driver does not say."""
    import ctypes
    import sys

    free, total, context = ctypes.c_size_t(), ctypes.c_size_t(), ctypes.c_void_p()
    try:
        name = "nvcuda.dll" if sys.platform == "win32" else "libcuda.so.1"
        cuda = ctypes.CDLL(name)
        failed = cuda.cuInit(0) or cuda.cuDevicePrimaryCtxRetain(ctypes.byref(context), 0)
        failed = failed or cuda.cuCtxPushCurrent_v2(context)
        failed = failed or cuda.cuMemGetInfo_v2(ctypes.byref(free), ctypes.byref(total))
        if not failed:
            cuda.cuCtxPopCurrent_v2(ctypes.byref(context))
            return free.value
    except (OSError, AttributeError):
        pass
    mi.Log(
        mi.LogLevel.Warn,
        "aniso_pm: the CUDA driver does not tell how much memory is free: none is spared; "
        'the parameter "max_memory" sets a limit',
    )
    return math.inf
