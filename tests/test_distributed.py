"""One picture on a cluster: the same as without, whoever differs, fails or is gone."""

import asyncio
import os
import signal
from contextlib import contextmanager
from pathlib import Path

import aniso_pm  # noqa: F401
import mitsuba as mi
import numpy as np
import psutil
import pytest
from aniso_pm.distributed import Options, render, worker
from aniso_pm.distributed.cluster import connected, local
from aniso_pm.errors import Failed, InputError
from aniso_pm.rendering.state import Checkpoint, State
from passes import SMALL
from rooms import room_with_ball
from test_parcel import spread  # noqa: F401  (a fixture)

# One process: one cluster.
pytestmark = pytest.mark.xdist_group("cluster")
SIZE = 16


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


@pytest.fixture(scope="module")
def client():
    with local(2) as client:
        yield client


def scene(**parameters):
    return room_with_ball(SIZE) | {"integrator": SMALL | parameters}


def alone(definition, spp, seed=0, **rules):
    """(picture, variance, statistics) of one process."""
    world = mi.load_dict(definition, optimize=False)
    plugin = world.integrator()
    plugin.stop_after(**rules)
    image = plugin.render(world, seed=seed, spp=spp)
    return np.array(image), plugin.variance, plugin.statistics


def assert_same_picture(found, expected):
    """The sums are in double precision: their order does not show. What does is the order in which
    threads add photons and samples up within a pass."""
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-4)


def test_workers_of_one_machine_share_its_memory(client, monkeypatch):
    def share():
        import dask
        from aniso_pm.distributed.cluster import MEMORY_SHARE

        return dask.config.get(MEMORY_SHARE, 1.0)

    assert list(client.run(share).values()) == [0.5, 0.5]
    monkeypatch.setattr("aniso_pm.rendering.memory.available", lambda: 8 * 2**30)
    planned = worker._planned
    assert planned(0.0, None, 0.5) == 3 and planned(2.0, None, 0.5) == 1
    assert planned(0.0, None, 1.0) == 0
    assert planned(0.0, 5.0, 1.0) == 5 and planned(2.0, 5.0, 1.0) == 2


def addresses(client):
    return sorted(client.scheduler_info()["workers"])


def on(client, address, function, *arguments):
    return client.run(function, *arguments, workers=[address])


@contextmanager
def fails_on(client, addresses, function, *arguments):
    """With something changed on some workers; they have to be like the others afterwards."""
    for address in addresses:
        on(client, address, function, *arguments)
    yield
    for address in addresses:
        on(client, address, _mend)


def _pretend_version(name, version):

    worker._mended = worker.versions
    worker.versions = lambda: worker._mended() | {name: version}


def _mend():

    worker.versions = worker._mended


# --- The same picture ---


def test_workers_render_the_same_picture_as_one_process(client):
    seen = []
    # A pilot chooses, pixel by pixel.
    chosen = scene(photon_count=0, initial_radius=0.0, layers="direct,caustic,indirect")
    done = render(
        chosen, client, spp=36, seed=3, passes=12, progress=lambda *what: seen.append(what)
    )
    image, variance, statistics = alone(chosen, 36, 3, passes=12)
    assert_same_picture(done.image, image)
    np.testing.assert_allclose(done.variance, variance, rtol=0.02, atol=1e-7)
    # The parts of the light come home as well, and are all of it.
    assert_same_picture(sum(done.layers.values()), image)
    for name in ("passes", "spp", "photons_emitted", "eye_samples", "map"):
        assert done.statistics[name] == statistics[name], name
    assert done.statistics["radius"] == pytest.approx(statistics["radius"], rel=1e-6)
    assert not done.statistics["interrupted"]
    assert [what[1] for what in seen] == [12] * len(seen) and seen[-1][0] == 12
    assert [what[0] for what in seen] == sorted(what[0] for what in seen)


@pytest.mark.slow
@pytest.mark.parametrize("passes, spp", [(1, 3), (4, 10)])
def test_passes_that_share_samples_unevenly_and_a_single_one(client, passes, spp):
    done = render(scene(passes=passes), client, spp=spp)
    image, variance, statistics = alone(scene(), spp, passes=passes)
    assert_same_picture(done.image, image)
    assert done.statistics["spp"] == spp and (done.variance is None) == (passes == 1)


def test_files_travel_to_workers_whose_directory_has_none(client, spread):  # noqa: F811
    folders = client.run(os.getcwd).values()
    assert not any((Path(folder) / "parts").exists() for folder in folders)
    done = render(spread, client, spp=4, passes=4, defines={"letter": "o"})
    world = mi.load_file(str(spread), optimize=False, letter="o")
    plugin = world.integrator()
    plugin.stop_after(passes=4)
    assert_same_picture(done.image, np.array(plugin.render(world, spp=4)))
    left = client.run(lambda dask_worker: os.listdir(dask_worker.local_directory))
    assert not any(name.startswith("scene-") for names in left.values() for name in names)


@pytest.mark.slow
def test_a_state_goes_on_with_other_workers_and_with_none(client, tmp_path):
    path = tmp_path / "a.state"
    world = mi.load_dict(scene(), optimize=False)
    plugin = world.integrator()
    plugin.stop_after(passes=3)
    plugin.checkpoint = Checkpoint(path)
    plugin.render(world, spp=6)
    done = render(scene(), client, spp=12, passes=6, checkpoint=Checkpoint(path, resume=True))
    assert done.statistics["passes"] == 6 and State.load(path).passes == [[0, 6]]
    plugin.stop_after(passes=8)
    plugin.checkpoint = Checkpoint(path, resume=True)
    image = np.array(plugin.render(world, spp=16))
    assert plugin.statistics["passes"] == 8
    assert_same_picture(image, alone(scene(), 16, passes=8)[0])


@pytest.mark.slow
def test_an_error_that_is_aimed_at_ends_rendering(client):
    done = render(scene(), client, spp=4, target_error=0.2)
    assert done.statistics["relative_error"] <= 0.2
    assert 4 <= done.statistics["passes"] < 2000


@pytest.mark.slow
def test_time_ends_rendering_but_not_before_the_first_pass(client):
    assert 1 <= render(scene(), client, spp=2, time=1e-3).statistics["passes"] <= 8


@pytest.mark.slow
def test_asynchronous_clients_are_awaited(client):
    from distributed import Client

    async def awaited():
        async with Client(client.scheduler.address, asynchronous=True) as own:
            return await render(scene(), own, spp=4, passes=2)

    done = asyncio.run(awaited())
    assert_same_picture(done.image, alone(scene(), 4, passes=2)[0])


# --- Agreement ---


def test_a_worker_of_another_version_is_named_and_not_used(client, capfd):
    other = addresses(client)[0]
    told = []
    with fails_on(client, [other], _pretend_version, "mitsuba", "3.0.0"):
        from aniso_pm import distributed

        elsewhere = distributed.Elsewhere

        def telling(*arguments):
            return elsewhere(*arguments, warn=told.append)

        distributed.Elsewhere = telling
        try:
            done = render(scene(), client, spp=4, passes=4)
        finally:
            distributed.Elsewhere = elsewhere
    assert done.statistics["passes"] == 4
    here = mi.__version__
    assert told == [
        f"worker {other} is not used: it has mitsuba 3.0.0, the client has {here}",
    ]


def test_everything_stops_in_one_sentence_where_no_worker_is_left(client):
    with fails_on(client, addresses(client), _pretend_version, "aniso_pm", "9.9"):
        with pytest.raises(Failed) as error:
            render(scene(), client, spp=4, passes=4)
    text = str(error.value)
    assert text.startswith("no worker is left that can render: ") and "\n" not in text
    for address in addresses(client):
        assert f"{address}: it has aniso_pm 9.9, the client has {aniso_pm.__version__}" in text


def test_another_scene_on_the_worker_is_noticed(client, monkeypatch):
    """The digest of what was loaded is compared, not that of the files."""
    from aniso_pm.distributed import dispatch

    def changed(world, own=dispatch.digest.scene_entries):
        return own(world) | {"scene, ceiling": "#0"}

    monkeypatch.setattr(dispatch.digest, "scene_entries", changed)
    with pytest.raises(Failed, match="another scene than the client: scene, ceiling has changed"):
        render(scene(), client, spp=4, passes=4)


def test_only_our_integrator_renders_elsewhere_and_files_have_to_be_there(client, tmp_path):
    with pytest.raises(InputError, match="only aniso_pm renders on workers.*PathIntegrator"):
        render(scene() | {"integrator": {"type": "path"}}, client)
    with pytest.raises(InputError, match="sky.filename"):
        render(scene() | {"sky": {"type": "envmap", "filename": "no.exr"}}, client)


# --- Security ---


def test_local_clusters_listen_on_the_loopback_address_only(client):
    listening = []
    for process in (psutil.Process(), *psutil.Process().children(recursive=True)):
        connections = process.net_connections("inet")
        listening += [c.laddr.ip for c in connections if c.status == psutil.CONN_LISTEN]
    assert len(listening) >= 3 and set(listening) <= {"127.0.0.1", "::1"}


def test_a_scheduler_that_is_not_there_is_one_sentence(tmp_path, monkeypatch):
    from aniso_pm.distributed import cluster

    monkeypatch.setattr(cluster, "_CONNECT", 1)
    with pytest.raises(InputError, match=r"no Dask scheduler answers at tcp://127\.0\.0\.1:9 "):
        with connected("tcp://127.0.0.1:9"):
            pass
    with pytest.raises(InputError, match="f.json: there is no such file"):
        with connected(scheduler_file=tmp_path / "f.json"):
            pass


# --- What goes wrong, for real ---


def test_a_worker_that_is_killed_costs_nothing(client):
    """Its nanny starts another, and somebody renders what it had."""
    processes = [facts["process"] for facts in client.run(_process).values()]
    expected = alone(scene(), 60, passes=60)[0]
    killed = []

    def kill(done, total, text):
        if done >= 8 and not killed:
            killed.append(processes[0])
            os.kill(killed[0], signal.SIGKILL)

    options = Options(task_seconds=0.2, home_every=0.3)
    done = render(scene(), client, spp=60, passes=60, progress=kill, options=options)
    assert killed and done.statistics["passes"] == 60 and done.statistics["spp"] == 60
    assert_same_picture(done.image, expected)
    client.wait_for_workers(2, timeout=60)


def _process():
    return {"process": os.getpid()}
