"""One progressive run: the picture at hand when each budget of seconds ends.

The clock counts what a warm rendering takes: preparing the scene, choosing the bandwidth (the
pilot), tracing the program in Python, photons, index, eye paths, gathering, the film. It does not
count compilation, which :func:`warm_up` does before and tells apart, nor developing and looking at
the pictures.

``aniso_pm`` renders passes of its own. Mitsuba's integrators are run again and again with other
seeds and the pictures added up: with few samples at first, and with as many as fit into the time
to the next budget later, so that their own costs of a call do not count against them.

Denoised methods trace what denoising needs while the clock runs. The denoiser itself, which takes
the same for all, is not on the clock.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from aniso_pm.pictures.denoising import denoise
from aniso_pm.rendering.film import pixel_weights

from .denoised import Calls, with_aovs
from .methods import Method

# Samples per pixel of one call of Mitsuba's integrators: each number compiles kernels of its own.
CALLS = (1, 4, 16, 64)
# Stages that come once, before the first pass.
SET_UP = ("prepare", "pilot")
# No call of more than one sample begins if it would not end in time, were it so much slower.
_MARGIN = 1.25
# Passes of a warm-up: buffers have found their size after the second.
_WARM_PASSES = 6
# Compilation on the clock that is not worth running once more, as a share of the first budget.
_COMPILED = 0.1


@dataclass
class Run:
    """What one run has given.

    images   (budgets, y, x, 3), single precision; NaN where there was no picture yet.
    seconds  after which the pictures were finished; NaN likewise.
    passes   calls or passes in each picture; 0 likewise.
    spp      samples per pixel in each picture.
    stages   seconds spent in each stage until the last picture.
    radius   bandwidth of the first pass, or None.
    denoiser_seconds  of the denoiser for one picture; None where nothing was denoised.
    """

    images: np.ndarray
    seconds: list[float]
    passes: list[int]
    spp: list[int]
    stages: dict[str, float] = field(default_factory=dict)
    radius: float | None = None
    denoiser_seconds: float | None = None

    @classmethod
    def without_pictures(cls, budgets: int, shape: tuple[int, ...]) -> Run:
        """To begin with. shape: of a picture."""
        images = np.full((budgets, *shape), np.nan, np.float32)
        return cls(images, [float("nan")] * budgets, [0] * budgets, [0] * budgets)


@dataclass(frozen=True)
class Stage:
    """Where runs take place: the scene, its camera, and what all photon mappers share."""

    scene: Any
    sensor: Any
    own: dict[str, Any]  # parameters of the scene's own integrator, if it is an aniso_pm
    limits: dict[str, Any]  # max_depth and hide_emitters, which every method has to honour
    photons: int
    spp: int  # samples per pixel of a pass
    # The scene and its camera with a box filter, which Mitsuba's integrators are denoised with.
    boxed: Callable[[], tuple[Any, Any]] | None = None

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of a picture."""
        width, height = self.sensor.film().crop_size()
        return height, width, 3

    def parameters(self, method: Method, radius: float | None) -> dict[str, Any]:
        """The plugin's parameters in this scene. radius: of the first pass, None: by default."""
        more: dict[str, Any] = {"layers": "denoising"} if method.ours and method.denoised else {}
        if not method.ours or method.installed:
            return self.limits | method.plugin | more
        passes = {"photon_count": self.photons, "passes": 0}
        if radius is not None:
            more["initial_radius"] = radius
        return self.own | self.limits | method.plugin | passes | more

    def seen_by(self, method: Method) -> tuple[Any, Any]:
        """Scene and camera of a method."""
        if method.denoised and not method.ours and self.boxed is not None:
            return self.boxed()
        return self.scene, self.sensor


def joined(first: Run, second: Run) -> Run:
    """Pictures of two runs with ascending budgets; all else is that of the second."""
    return Run(
        np.concatenate([first.images, second.images]),
        first.seconds + second.seconds,
        first.passes + second.passes,
        first.spp + second.spp,
        second.stages,
        second.radius,
        second.denoiser_seconds,
    )


def run(stage: Stage, method: Method, radius: float | None, seed: int, budgets: list[float]) -> Run:
    """Run ``method`` once. radius: bandwidth of the first pass; None lets the pilot choose.

    budgets  seconds, ascending.
    """
    found, layers = recorded(stage, method, radius, seed, budgets)
    if not method.denoised:
        return found
    took = []
    for k, known in enumerate(layers):
        if known is not None:
            began = time.perf_counter()
            found.images[k] = denoise(found.images[k], known)
            took.append(time.perf_counter() - began)
    found.denoiser_seconds = float(np.mean(took)) if took else None
    return found


def recorded(
    stage: Stage, method: Method, radius: float | None, seed: int, budgets: list[float]
) -> tuple[Run, list[dict[str, np.ndarray] | None]]:
    """As :func:`run`, but pictures of denoised methods are left raw; what denoising needs is beside
    each (None: no picture yet, or the method is not denoised)."""
    recorder = _Recorder(budgets, stage.shape)
    if not method.ours:
        _calls(stage, method, seed, recorder)
    elif _passes(stage, method, radius, seed, recorder) > _COMPILED * budgets[0]:
        # Pilots of other seeds choose other kernels, which nobody has warmed up: now they are.
        recorder = _Recorder(budgets, stage.shape)
        _passes(stage, method, radius, seed, recorder)
    return recorder.run, recorder.layers


class _Recorder:
    """Keeps the last picture within each budget, and its layers."""

    def __init__(self, budgets: list[float], shape: tuple[int, ...]):
        self.budgets = budgets
        self.run = Run.without_pictures(len(budgets), shape)
        self.layers: list[dict[str, np.ndarray] | None] = [None] * len(budgets)

    def add(self, image, stages: dict[str, float], passes: int, spp: int, layers=None) -> bool:
        """Note a finished picture (y, x, 3 or more). Returns whether time is up."""
        seconds = sum(stages.values())
        for k, budget in enumerate(self.budgets):
            if seconds <= budget:
                self.run.images[k], self.layers[k] = image[..., :3], layers
                self.run.seconds[k], self.run.passes[k], self.run.spp[k] = seconds, passes, spp
        if seconds <= self.budgets[-1]:
            self.run.stages = stages
        return seconds > self.budgets[-1]


class _Enough(Exception):  # noqa: N818 (not an error)
    """Ends a rendering from its callback."""


def _passes(stage: Stage, method: Method, radius, seed: int, recorder: _Recorder) -> float:
    """Passes of an ``aniso_pm``. Returns the seconds that compilation took in the first of them."""
    parameters = stage.parameters(method, radius)
    # The rule for time is the last resort: looking at pictures does not count here, but there.
    integrator = mi.load_dict(parameters | {"time": 4 * recorder.budgets[-1] + 60})

    began, prepare, compiled = time.perf_counter(), None, 0.0

    def after_pass(index, image, statistics):
        nonlocal prepare, compiled
        stages = {name: t for name, t in statistics["seconds"].items() if name != "output"}
        if prepare is None:
            # What the integrator does before its own clock begins.
            prepare = time.perf_counter() - began - sum(stages.values())
            compiled = _compilation()
        dr.kernel_history_clear()  # kept on: what is frozen is traced anew where a flag changes
        stages = {"prepare": prepare, **stages}
        recorder.run.radius = statistics["initial_radius"]
        layers = dict(integrator.layers) if method.denoised else None
        if recorder.add(np.array(image), stages, index + 1, statistics["spp"], layers):
            raise _Enough

    integrator.callback = after_pass
    recording = dr.flag(dr.JitFlag.KernelHistory)
    dr.kernel_history_clear()
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    try:
        spp = 0 if method.installed else stage.spp  # as the scene's sampler says
        integrator.render(stage.scene, sensor=stage.sensor, seed=seed, spp=spp)
    except _Enough:
        return compiled
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, recording)
    if integrator.statistics["interrupted"]:
        raise KeyboardInterrupt
    return compiled


def _calls(stage: Stage, method: Method, seed: int, recorder: _Recorder) -> None:
    """Calls of one of Mitsuba's integrators, their pictures averaged."""
    integrator, aovs = _mitsubas(stage, method)
    scene, sensor = stage.seen_by(method)
    beside = Calls(pixel_weights(stage.sensor.film()), aovs) if method.denoised else None
    budgets = recorder.budgets
    total, spp, seconds, calls = 0.0, 0, 0.0, 0
    took: dict[int, float] = {}  # seconds of a call, by its samples
    done = False
    while not done:
        count = _samples(took, next(b for b in budgets if b >= seconds) - seconds)
        random = mi.sample_tea_32(seed, calls)[0]
        began = time.perf_counter()
        integrator.render(scene, sensor=sensor, seed=random, spp=count, develop=False)
        dr.sync_thread()
        took[count] = time.perf_counter() - began
        taken = sensor.sampler().sample_count()  # samplers may round it up
        image = np.array(sensor.film().develop(), np.float64)
        spp, seconds, calls = spp + taken, seconds + took[count], calls + 1
        if beside is None:
            total = total + taken * image[..., :3]
            done = recorder.add(total / spp, {"render": seconds}, calls, spp)
        else:
            beside.add(image, taken)
            stages = {"render": seconds}
            done = recorder.add(beside.picture, stages, calls, spp, beside.layers)
    _put_back(sensor)


def _put_back(sensor) -> None:
    """The sampler's last state has not been computed: the next method would do it, on its clock, at
    the price of the whole call."""
    sensor.sampler().seed(0, 1)


def _mitsubas(stage: Stage, method: Method) -> tuple[Any, bool]:
    """One of Mitsuba's integrators, and whether it gives albedo and normal as well."""
    parameters = stage.parameters(method, None)
    return with_aovs(parameters) if method.denoised else (mi.load_dict(parameters), False)


def _samples(took: dict[int, float], left: float) -> int:
    """How many samples per pixel to take at once if ``left`` seconds are left to the budget."""
    best = CALLS[0]
    for smaller, count in zip(CALLS, CALLS[1:], strict=False):
        # Nobody knows yet how long so many take: at most in proportion.
        known = took.get(count, took.get(smaller, float("inf")) * count / smaller)
        if _MARGIN * known > left:
            break
        best = count
    return best


def warm_up(stage: Stage, method: Method, radius: float | None, seed: int) -> dict[str, Any]:
    """Render a little, so that all kernels are compiled. Returns ``compile_seconds`` (those found
    in Dr.Jit's cache on the disk take next to none) and ``radius``, that of the first pass."""
    recording = dr.flag(dr.JitFlag.KernelHistory)
    dr.kernel_history_clear()
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    first = None
    try:
        if method.ours:
            parameters = stage.parameters(method, radius) | {"passes": _WARM_PASSES}
            integrator = mi.load_dict(parameters)
            spp = _WARM_PASSES * stage.spp
            integrator.render(stage.scene, sensor=stage.sensor, seed=seed, spp=spp)
            first = integrator.statistics["initial_radius"]
        else:
            integrator, _ = _mitsubas(stage, method)
            scene, sensor = stage.seen_by(method)
            for count in CALLS:
                integrator.render(scene, sensor=sensor, seed=seed, spp=count)
            _put_back(sensor)
        dr.sync_thread()
        seconds = _compilation()
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, recording)
        dr.kernel_history_clear()
    return {"compile_seconds": seconds, "radius": first}


def _compilation() -> float:
    """Seconds that the kernels of Dr.Jit's history took, which is cleared."""
    kernels = [kernel for kernel in dr.kernel_history() if "backend_time" in kernel]
    dr.kernel_history_clear()
    return sum(k["codegen_time"] + k["backend_time"] for k in kernels) / 1000
