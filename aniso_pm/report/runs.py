"""One progressive run: the picture at hand when each budget of seconds ends.

The clock counts what a warm rendering takes: preparing the scene, choosing the bandwidth (the
pilot), tracing the program in Python, photons, index, eye paths, gathering, the film. It does not
count compilation, which :func:`warm_up` does before and tells apart, nor developing and looking at
the pictures.

``aniso_pm`` renders passes of its own. Mitsuba's integrators are run again and again with other
seeds and the pictures added up: with few samples at first, and with as many as fit into the time
to the next budget later, so that their own costs of a call do not count against them.
"""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from .methods import Method

# Samples per pixel of one call of Mitsuba's integrators: each number compiles kernels of its own.
CALLS = (1, 4, 16, 64)
# Stages that come once, before the first pass.
SET_UP = ("prepare", "pilot")
# No call of more than one sample begins if it would not end in time, were it so much slower.
_MARGIN = 1.25
# Passes of a warm-up: buffers have found their size after the second.
_WARM_PASSES = 6


@dataclass
class Run:
    """What one run has given.

    images   (budgets, y, x, 3), single precision; NaN where there was no picture yet.
    seconds  after which the pictures were finished; NaN likewise.
    passes   calls or passes in each picture; 0 likewise.
    spp      samples per pixel in each picture.
    stages   seconds spent in each stage until the last picture.
    radius   bandwidth of the first pass, or None.
    """

    images: np.ndarray
    seconds: list[float]
    passes: list[int]
    spp: list[int]
    stages: dict[str, float] = field(default_factory=dict)
    radius: float | None = None

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

    @property
    def shape(self) -> tuple[int, int, int]:
        """Of a picture."""
        width, height = self.sensor.film().crop_size()
        return height, width, 3

    def parameters(self, method: Method, radius: float | None) -> dict[str, Any]:
        """The plugin's parameters in this scene. radius: of the first pass, None: by default."""
        if not method.ours:
            return self.limits | method.plugin
        passes = {"photon_count": self.photons, "passes": 0}
        bandwidth = {} if radius is None else {"initial_radius": radius}
        return self.own | self.limits | method.plugin | passes | bandwidth


def joined(first: Run, second: Run) -> Run:
    """Pictures of two runs with ascending budgets; stages and radius are those of the second."""
    return Run(
        np.concatenate([first.images, second.images]),
        first.seconds + second.seconds,
        first.passes + second.passes,
        first.spp + second.spp,
        second.stages,
        second.radius,
    )


def run(stage: Stage, method: Method, radius: float | None, seed: int, budgets: list[float]) -> Run:
    """Run ``method`` once. radius: bandwidth of the first pass; None lets the pilot choose.

    budgets  seconds, ascending.
    """
    recorder = _Recorder(budgets, stage.shape)
    parameters = stage.parameters(method, radius)
    (_passes if method.ours else _calls)(stage, parameters, seed, recorder)
    return recorder.run


class _Recorder:
    """Keeps the last picture within each budget."""

    def __init__(self, budgets: list[float], shape: tuple[int, ...]):
        self.budgets = budgets
        self.run = Run.without_pictures(len(budgets), shape)

    def add(self, image, stages: dict[str, float], passes: int, spp: int) -> bool:
        """Note a finished picture (y, x, 3 or more). Returns whether time is up."""
        seconds = sum(stages.values())
        for k, budget in enumerate(self.budgets):
            if seconds <= budget:
                self.run.images[k] = image[..., :3]
                self.run.seconds[k], self.run.passes[k], self.run.spp[k] = seconds, passes, spp
        if seconds <= self.budgets[-1]:
            self.run.stages = stages
        return seconds > self.budgets[-1]


class _Enough(Exception):  # noqa: N818 (not an error)
    """Ends a rendering from its callback."""


def _passes(stage: Stage, parameters, seed: int, recorder: _Recorder) -> None:
    """Passes of an ``aniso_pm``."""
    # The rule for time is the last resort: looking at pictures does not count here, but there.
    integrator = mi.load_dict(parameters | {"time": 4 * recorder.budgets[-1] + 60})

    began, prepare = time.perf_counter(), None

    def after_pass(index, image, statistics):
        nonlocal prepare
        stages = {name: t for name, t in statistics["seconds"].items() if name != "output"}
        if prepare is None:
            # What the integrator does before its own clock begins.
            prepare = time.perf_counter() - began - sum(stages.values())
        stages = {"prepare": prepare, **stages}
        recorder.run.radius = statistics["initial_radius"]
        if recorder.add(np.array(image), stages, index + 1, statistics["spp"]):
            raise _Enough

    integrator.callback = after_pass
    try:
        integrator.render(stage.scene, sensor=stage.sensor, seed=seed, spp=stage.spp)
    except _Enough:
        return
    if integrator.statistics["interrupted"]:
        raise KeyboardInterrupt


def _calls(stage: Stage, parameters, seed: int, recorder: _Recorder) -> None:
    """Calls of one of Mitsuba's integrators, their pictures averaged."""
    integrator = mi.load_dict(parameters)
    sensor, budgets = stage.sensor, recorder.budgets
    total, spp, seconds, calls = 0.0, 0, 0.0, 0
    took: dict[int, float] = {}  # seconds of a call, by its samples
    done = False
    while not done:
        count = _samples(took, next(b for b in budgets if b >= seconds) - seconds)
        random = mi.sample_tea_32(seed, calls)[0]
        began = time.perf_counter()
        integrator.render(stage.scene, sensor=sensor, seed=random, spp=count, develop=False)
        dr.sync_thread()
        took[count] = time.perf_counter() - began
        taken = sensor.sampler().sample_count()  # samplers may round it up
        total = total + taken * np.array(sensor.film().develop(), np.float64)[..., :3]
        spp, seconds, calls = spp + taken, seconds + took[count], calls + 1
        done = recorder.add(total / spp, {"render": seconds}, calls, spp)


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
    parameters = stage.parameters(method, radius)
    first = None
    try:
        if method.ours:
            integrator = mi.load_dict(parameters | {"passes": _WARM_PASSES})
            spp = _WARM_PASSES * stage.spp
            integrator.render(stage.scene, sensor=stage.sensor, seed=seed, spp=spp)
            first = integrator.statistics["initial_radius"]
        else:
            integrator = mi.load_dict(parameters)
            for count in CALLS:
                integrator.render(stage.scene, sensor=stage.sensor, seed=seed, spp=count)
        dr.sync_thread()
        kernels = [kernel for kernel in dr.kernel_history() if "backend_time" in kernel]
    finally:
        dr.set_flag(dr.JitFlag.KernelHistory, recording)
        dr.kernel_history_clear()
    seconds = sum(k["codegen_time"] + k["backend_time"] for k in kernels) / 1000
    return {"compile_seconds": seconds, "radius": first}
