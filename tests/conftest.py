"""Fixtures that set a Mitsuba variant for one test and the earlier one afterwards, and that run the
program `aniso-pm`."""

import aniso_pm  # noqa: F401  (before drjit, so that it can choose LLVM)  # isort: skip
import gc
import time

import command_line
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm import cli
from aniso_pm.rendering.pilot import Settled

VARIANTS = ("llvm_ad_rgb", "llvm_ad_mono", "llvm_ad_spectral")


def pytest_collection_finish():
    """Renderings look for scenes that nobody uses any more, and need not look through all that
    tests have imported."""
    gc.collect()
    gc.freeze()


def _use(variant):
    before = mi.variant()
    mi.set_variant(variant)
    yield variant
    if before:
        mi.set_variant(before)


@pytest.fixture
def variant_llvm_rgb():
    yield from _use("llvm_ad_rgb")


@pytest.fixture
def rgb(variant_llvm_rgb):
    pass


@pytest.fixture
def variant_llvm_mono():
    yield from _use("llvm_ad_mono")


@pytest.fixture
def variant_llvm_spectral():
    yield from _use("llvm_ad_spectral")


@pytest.fixture(params=VARIANTS)
def variants_all(request):
    yield from _use(request.param)


@pytest.fixture
def without_pilot(request, monkeypatch):
    """Plain choices where the pilot is not what a test is about: most of what such tests compile
    would be the pilot's kernels. Tests marked ``with_pilot`` have one."""
    if request.node.get_closest_marker("with_pilot"):
        return

    leave_out_the_pilot(monkeypatch)


def leave_out_the_pilot(monkeypatch):
    def settled(scene, sensor, seed, each):
        use = "global" if scene.undecided else scene.use
        count = scene.settings.photon_count or 10_000
        radius = scene.settings.initial_radius or 0.02 * scene.extent
        even = np.ones(1)
        return Settled(use, {}, count, radius, each, even, None, even, None, 1.0)

    monkeypatch.setattr("aniso_pm.rendering.beginning.settle", settled)


def slow(*values):
    """Of a list of parameters, those that only ``pytest -m slow`` takes."""
    return [
        pytest.param(*(v if isinstance(v, tuple) else (v,)), marks=pytest.mark.slow) for v in values
    ]


@pytest.fixture
def ticking(monkeypatch):
    """As :func:`tick`, for one test."""
    return tick(monkeypatch)


def tick(monkeypatch):
    """A clock by which each look at it takes a millisecond, however busy the machine is. Returns
    a function that lets more time go by."""
    now = [time.perf_counter()]

    def pass_by(seconds):
        now[0] += seconds
        return now[0]

    monkeypatch.setattr(time, "perf_counter", lambda: pass_by(0.001))
    return pass_by


# --- The program aniso-pm ---


@pytest.fixture
def run(tmp_path, capfd, monkeypatch):
    """Run the program in this process, in an empty directory: (status, stdout, stderr)."""
    monkeypatch.chdir(tmp_path)
    before = mi.variant()

    def run(*arguments):
        status = cli.main([str(argument) for argument in arguments])
        return status, *capfd.readouterr()

    yield run
    if before:
        mi.set_variant(before)


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    """A cache of references that neither the user nor another test has written to."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))


@pytest.fixture
def write_scene(tmp_path):
    """Write a scene and return its path."""

    def write(integrator=command_line.PATH, extra="", text=command_line.SCENE):
        path = tmp_path / "scene.xml"
        path.write_text(text.replace("{integrator}", integrator).replace("{extra}", extra))
        return path

    return write
