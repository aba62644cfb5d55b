"""Memory: the estimate, wavefronts that fit into it, and the refusal of what cannot fit."""

import json
import subprocess
import sys
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm import cli
from aniso_pm.rendering import memory, pilot
from aniso_pm.rendering.prepared import prepare
from aniso_pm.rendering.settings import Settings
from aniso_pm.rendering.state import Checkpoint
from aniso_pm.transport import photons
from rooms import room, room_with_ball, room_with_plate

pytestmark = pytest.mark.usefixtures("without_pilot")

GIB = memory.GIB
SMALL = {"type": "aniso_pm", "map": "global", "photon_count": 40_000, "initial_radius": 0.1}


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


def plan(definition, max_memory=0.0, pixels=256**2, samples=1 << 21, stored=1e6, **settings):
    scene = prepare(mi.load_dict(definition), Settings(max_memory=max_memory, **settings), False)
    job = memory.Job(stored, pixels, 4, False, samples)
    return memory.fitting(scene, job, lambda: stored)


def picture(definition, spp=16, seed=0, **parameters):
    plugin = mi.load_dict(SMALL | parameters)
    image = plugin.render(mi.load_dict(definition), seed=seed, spp=spp)
    return np.array(image, dtype=np.float64), plugin


# --- The estimate ---

_MEASURE = """
import json, resource, sys
import aniso_pm
import mitsuba as mi
mi.set_variant("llvm_ad_rgb")
sys.path.insert(0, sys.argv[1])
import rooms
name, size, spp, parameters = json.loads(sys.argv[2])
scene = mi.load_dict(rooms.ROOMS[name](size=size))
plugin = mi.load_dict({"type": "aniso_pm", "map": "global", "initial_radius": 0.01} | parameters)
before = int(open("/proc/self/statm").read().split()[1]) * resource.getpagesize()
plugin.render(scene, spp=spp)
# Not ru_maxrss: that of a large parent process survives fork and exec.
status = open("/proc/self/status").read()
peak = 1024 * int(status.partition("VmHWM:")[2].split()[0])
print(json.dumps([peak - before, plugin.statistics["memory_estimate"] * 2**30]))
"""


@pytest.mark.skipif(sys.platform != "linux", reason="reads /proc")
@pytest.mark.parametrize(
    "job",
    [
        ("room", 32, 1, {"photon_count": 1_000_000}),
        ("plate", 500, 8, {"photon_count": 50_000}),
        pytest.param(
            ("plate", 700, 2, {"photon_count": 500_000, "passes": 2}), marks=pytest.mark.slow
        ),
        pytest.param(
            ("ball", 400, 4, {"photon_count": 100_000, "map": "caustic"}), marks=pytest.mark.slow
        ),
        pytest.param(
            ("room", 32, 1, {"photon_count": 1_000_000, "gather_tolerance": 0.05}),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            ("plate", 700, 2, {"photon_count": 300_000, "final_gather": True}),
            marks=pytest.mark.slow,
        ),
    ],
    ids=lambda job: " ".join(map(str, job[:3])),
)
def test_the_estimate_is_what_the_process_grows_by(job):
    """Resident memory of a new process, within a factor of 1.5 both ways. The first two are those
    that photons and eye samples dominate."""
    command = [sys.executable, "-c", _MEASURE, str(Path(__file__).parent), json.dumps(job)]
    out = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    measured, estimated = json.loads(out.splitlines()[-1])
    print(f"{job}: {measured / GIB:.3f} GiB, estimate {estimated / GIB:.3f}")
    assert 1 / 1.5 < estimated / measured < 1.5


def test_thirty_million_photons_and_a_large_film_fit_into_24_gib():
    large = plan(room_with_plate(8), 0.75 * 24, 4096**2, 4096**2, 3e7, photon_count=10_000_000)
    assert large.bytes < 0.75 * 24 * GIB
    assert large.light_paths == photons.WAVEFRONT and large.eye_samples == 4096**2


def test_the_bound_of_photons_holds_and_the_measured_number_is_right():
    scene = prepare(mi.load_dict(room(size=4)), Settings(map="global", photon_count=100_000), False)
    stored = scene.photon_map(0, 0).stored
    assert 1e5 * pilot.photons_per_path(scene, 0) == pytest.approx(stored, rel=0.02)
    assert stored < 25 * 1e5


# --- Wavefronts ---


def test_nothing_is_split_and_nothing_measured_where_memory_suffices():
    scene = prepare(mi.load_dict(room(size=4)), Settings(max_memory=16.0), False)
    job = memory.Job(1e6, 16, 4, False, 1 << 21)
    found = memory.fitting(scene, job, lambda: pytest.fail("the bound fits"))
    assert (found.light_paths, found.eye_samples) == (photons.WAVEFRONT, 1 << 21)


def test_what_takes_most_is_halved_first_and_the_result_fits():
    before = plan(room(size=4), 16.0, stored=1e5)
    for share in (0.8, 0.5, 0.3):
        limit = share * before.bytes
        after = plan(room(size=4), limit / GIB, stored=1e5)
        assert after.bytes <= limit
        assert memory.SMALLEST <= after.eye_samples < before.eye_samples
        # No more than needed
        assert memory.replace(after, eye_samples=2 * after.eye_samples).bytes > limit


@pytest.mark.parametrize(
    "sampler, film",
    [
        ("multijitter", {"rfilter": {"type": "gaussian"}, "sample_border": True}),
        pytest.param("independent", {}, marks=pytest.mark.slow),
    ],
)
def test_parts_of_the_film_are_the_picture_of_the_whole(monkeypatch, film, sampler):
    """A film of more pixels than a wavefront may have, and not a multiple of it."""
    definition = room_with_plate(36)
    definition["sensor"]["film"] |= film
    definition["sensor"]["sampler"] = {"type": sampler}
    whole, plugin = picture(definition, max_memory=16.0)
    again, _ = picture(definition, seed=1, max_memory=16.0)
    apart = lambda image: np.quantile(np.abs(image - whole), 0.8)  # noqa: E731 (no fireflies)
    scene, border = prepare(mi.load_dict(definition), plugin.settings, False), 4 if film else 0
    stored = 40_000 * pilot.photons_per_path(scene, 0)
    job = memory.Job(stored, (36 + border) ** 2, 4, False, 16 * (36 + border) ** 2)
    monkeypatch.setattr(memory, "SMALLEST", 500)
    limit = memory.Wavefronts(scene, job, 20_000, 700).bytes
    parts, small = picture(definition, max_memory=limit / GIB)
    s, t = plugin.statistics, small.statistics
    assert t["wavefront_eye_samples"] < 36**2 < s["wavefront_eye_samples"]
    assert t["wavefront_light_paths"] < 40_000 < s["wavefront_light_paths"]
    for name in ("spp", "eye_samples", "photons_emitted"):
        assert s[name] == t[name], name
    # From seed to seed the photons alone change it by 1 %.
    assert parts.mean() == pytest.approx(whole.mean(), rel=0.04)
    # Pixel by pixel about as far apart as two seeds are: no part is missing, doubled or misplaced.
    # (Samplers that stratify the samples of a pixel do so within a wavefront.)
    assert apart(parts) < 1.5 * apart(again)


def test_small_wavefronts_of_light_paths_leave_the_same_photons():
    scene = prepare(mi.load_dict(room(size=4)), Settings(map="global", photon_count=100_000), False)
    whole = scene.photon_map(0, 0)
    parts = memory.replace(scene, light_wavefront=1 << 14).photon_map(0, 0)
    assert parts.emitted == whole.emitted
    assert parts.stored == pytest.approx(whole.stored, rel=0.02)
    energy = [float(dr.sum(m.flux)[0]) for m in (whole, parts)]
    assert energy[1] == pytest.approx(energy[0], rel=0.02)


def test_max_memory_is_no_reason_to_refuse_a_resumed_picture(tmp_path):
    scene = mi.load_dict(room(size=8))
    for passes, max_memory in ((2, 0.0), (4, 8.0)):
        plugin = mi.load_dict(SMALL | {"passes": passes, "max_memory": max_memory})
        plugin.checkpoint = Checkpoint(tmp_path / "a.state", resume=True)
        plugin.render(scene, spp=2 * passes)
    assert plugin.statistics["passes"] == 4


# --- Refusals ---


def test_what_cannot_fit_is_refused_before_it_starts():
    scene = mi.load_dict(room(size=64))
    plugin = mi.load_dict(SMALL | {"max_memory": 0.1, "photon_count": 10_000_000})
    with pytest.raises(ValueError, match='"max_memory" is 0.1 GiB.*lower "photon_count"') as error:
        plugin.render(scene, spp=1)
    assert "map of 2.3e+07 photons" in str(error.value)
    assert plugin.statistics == {}


def test_a_film_that_is_too_large_is_named(tmp_path, capsys):
    scene = tmp_path / "s.xml"
    scene.write_text(
        '<scene version="3.0.0"><sensor type="perspective"><film type="hdrfilm">'
        '<integer name="width" value="3000"/><integer name="height" value="2000"/></film></sensor>'
        '<integrator type="aniso_pm"><float name="max_memory" value="0.2"/></integrator>'
        '<emitter type="point"/><shape type="sphere"/></scene>'
    )
    assert cli.main(["render", str(scene), "-o", str(tmp_path / "a.exr"), "--spp", "1"]) == 2
    stderr = capsys.readouterr().err
    assert stderr.count("\n") == 1 and "the film of 6000000 pixels" in stderr
    assert "lower the size of the film or give a larger max_memory" in stderr
    assert not (tmp_path / "a.exr").exists()


# --- What there is ---


@pytest.mark.parametrize("version", [1, 2])
def test_control_groups_limit_what_is_available(tmp_path, version):
    assert memory.cgroup_available(tmp_path) == float("inf")
    (tmp_path / "proc/self").mkdir(parents=True)
    line = "4:cpu,memory:/outer/inner\n2:cpuset:/other" if version == 1 else "0::/outer/inner"
    (tmp_path / "proc/self/cgroup").write_text(line)
    top = tmp_path / "sys/fs/cgroup" / ("memory" if version == 1 else "")
    limit, usage, cached = (
        ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file")
        if version == 1
        else ("memory.max", "memory.current", "inactive_file")
    )
    unlimited = str(2**63 - 4096) if version == 1 else "max"
    for group, maximum in (("outer", 8 * GIB), ("outer/inner", unlimited)):
        (top / group).mkdir(parents=True)
        (top / group / limit).write_text(f"{maximum}\n")
        (top / group / usage).write_text(f"{3 * GIB}\n")
        (top / group / "memory.stat").write_text(f"anon 5\n{cached} {GIB}\n")
    assert memory.cgroup_available(tmp_path) == 6 * GIB


def test_automatic_is_three_quarters_of_what_is_available(monkeypatch):
    monkeypatch.setattr(memory, "available", lambda: 4.0 * GIB)
    with pytest.raises(ValueError, match=r"0 \(automatic: 3 GiB"):
        plan(room(size=4), stored=1e9)
    assert plan(room(size=4)).bytes < 3 * GIB


def test_this_machine_has_memory():
    assert 1 << 26 < memory.available() < 1 << 46


# --- map=auto ---


def kernels(scene, **parameters):
    """Hashes of all kernels of a rendering in which anything is traced or gathered; Dr.Jit orders
    what small ones do by where its arrays lie."""
    plugin = mi.load_dict(SMALL | parameters)
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        dr.kernel_history_clear()
        plugin.render(scene, spp=4)
        history = dr.kernel_history()
    history = [k for k in history if k["type"] == dr.KernelType.JIT]
    return sorted(k["hash"] for k in history if k["operation_count"] > 300), plugin


def test_auto_is_no_map_in_a_plain_room_as_the_caustic_map_is():
    scene = mi.load_dict(room(size=8))
    auto, plugin = kernels(scene, map="auto")
    caustic, whole = (kernels(scene, map=name)[0] for name in ("caustic", "global"))
    assert auto == caustic != whole
    assert plugin.statistics["map"] == "none" and plugin.statistics["photons_emitted"] == 0


@pytest.mark.parametrize("make", [room_with_ball, room_with_plate])
def test_auto_is_the_global_map_where_something_casts_caustics(make):
    scene = prepare(mi.load_dict(make(size=4)), Settings(map="auto"), False)
    assert scene.use == "global" and scene.needs_map


def test_auto_equals_path_in_a_plain_room():
    definition = room(size=16)
    ours, _ = picture(definition, 1024, map="auto")
    path = mi.load_dict({"type": "path"}).render(mi.load_dict(definition), seed=5, spp=1024)
    assert ours.mean() == pytest.approx(np.array(path).mean(), rel=0.005)
