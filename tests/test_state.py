"""States on disk: resumed, merged, refused by name where they belong to something else."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import aniso_pm  # noqa: F401
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.rendering import beginning, survey
from aniso_pm.rendering.digest import differences, scene_entries
from aniso_pm.rendering.settled import Settled
from aniso_pm.rendering.state import Checkpoint, State, StateError, describe, merge
from aniso_pm.transport import aim
from aniso_pm.transport.focus import Focus
from conftest import leave_out_the_pilot
from passes import close, integrator, load, render
from rooms import room, room_with_plate

pytestmark = pytest.mark.usefixtures("without_pilot")


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    mi.set_variant("llvm_ad_rgb")
    scene, folder = load(), tmp_path_factory.mktemp("states")
    paths = [folder / "a.state", folder / "b.state"]
    with pytest.MonkeyPatch.context() as patch:
        leave_out_the_pilot(patch)
        for path, first in zip(paths, (0, 2), strict=True):
            render(scene, integrator(passes=2), 4, 1, first, Checkpoint(path))
        return paths, scene, render(scene, integrator(passes=4), 8)


@pytest.fixture
def states(made, tmp_path):
    """Files with passes 0-1 and 2-3, and the picture of all four."""
    paths, scene, whole = made
    return [Path(shutil.copy(path, tmp_path)) for path in paths], scene, whole


def test_states_merge_into_the_picture_of_all_passes(states):
    paths, scene, whole = states
    for order in (paths, paths[::-1]):
        total = merge({path.name: State.load(path) for path in order})
        assert total.passes == [[0, 4]] and total.statistics["spp"] == 8
        assert total.statistics["photons_emitted"] == 4 * 3000
        # What is chosen once does not add up; what each pass takes does.
        one = State.load(paths[0]).statistics
        for name in ("share_of_gathers", "error_behind_lobes", "wavefront_eye_samples", "map"):
            assert total.statistics[name] == one[name], name
        assert total.statistics["seconds"]["photons"] > one["seconds"]["photons"]
        close(total.arrays["first"][..., :-1] / total.arrays["first"][..., -1:], whole)
    plugin = integrator(passes=4)
    render(scene, plugin, 8)
    np.testing.assert_allclose(total.variance(), plugin.variance, rtol=0.02, atol=1e-7)
    # Told of all passes, not of those of one state.
    error, radius = (plugin.statistics[name] for name in ("relative_error", "radius"))
    assert total.statistics["relative_error"] == pytest.approx(error, rel=0.02)
    assert total.statistics["radius"] == pytest.approx(radius)


def test_resuming_renders_the_missing_passes_only(states):
    paths, scene, whole = states
    plugin = integrator(passes=4)
    seen = []
    plugin.callback = lambda i, image, statistics: seen.append(i)
    image = render(scene, plugin, 8, checkpoint=Checkpoint(paths[1], resume=True))
    assert seen == [0, 1]
    close(image, whole)
    assert plugin.statistics["passes"] == 4 and plugin.statistics["spp"] == 8
    seen.clear()
    close(render(scene, plugin, 8, checkpoint=Checkpoint(paths[1], resume=True)), whole)
    assert seen == []


@pytest.mark.with_pilot
def test_resuming_keeps_the_bandwidth_and_the_kernels_that_the_pilot_chose(tmp_path):
    path = tmp_path / "a.state"
    scene = load()
    free = {"initial_radius": 0.0, "photon_count": 0, "kernel": "auto"}
    render(scene, integrator(passes=2, **free), 4, checkpoint=Checkpoint(path))
    state = State.load(path)
    chosen, followed = state.settled, state.identity["lobes followed"]
    assert followed == (state.statistics["kernel"] == "anisotropic")
    state.settled = replace(chosen, radius=0.5 * chosen.radius, lobes=0.0 if followed else 1.0)
    state.identity |= {"initial radius": 0.5 * chosen.radius, "lobes followed": not followed}
    state.save(path)
    plugin = integrator(passes=3, **free)
    render(scene, plugin, 6, checkpoint=Checkpoint(path, resume=True))
    assert plugin.statistics["initial_radius"] == 0.5 * chosen.radius
    assert plugin.statistics["kernel"] == ("isotropic" if followed else "anisotropic")


@pytest.mark.with_pilot
def test_resumed_renderings_of_open_end_have_no_other_pilot(tmp_path, monkeypatch):
    path, scene = tmp_path / "a.state", load()
    monkeypatch.setattr(survey, "_LONGEST", 1e5)  # a pass of fewer samples than are asked for
    parameters = {"initial_radius": 0.0, "photon_count": 0, "time": 1e-3}
    render(scene, integrator(**parameters), 64, checkpoint=Checkpoint(path))
    before = State.load(path)
    assert before.count == 1 and before.settled.each < 64 and before.settled.share.size > 1
    monkeypatch.setattr(beginning, "settle", lambda *_: pytest.fail("a pilot"))
    resumed = integrator(**parameters | {"time": 0.0, "passes": 2})
    render(scene, resumed, 2 * 64, checkpoint=Checkpoint(path, resume=True))
    after = State.load(path)
    assert after.count == 2
    assert_same_choice(after.settled, before.settled)


def assert_same_choice(one, other):
    """Every field, aims field by field: not by what makes states of them."""
    for name, value in vars(other).items():
        found = getattr(one, name)
        assert type(found) is type(value), name
        if name == "aim" and value is not None:
            found, value = vars(found), vars(value)
        np.testing.assert_equal(found, value, name)


def test_what_was_chosen_survives_the_disk(tmp_path):
    boxes = np.random.default_rng(1).random((3, 4, 5))
    aimed = aim.Learned(boxes[0], boxes[1], boxes[2][:, 0], 0.5, 0.7, 0.9)
    pixels = np.arange(12)
    numbers = pixels.astype(np.float32)
    few = np.ones(1, np.float32)
    path, scene = tmp_path / "a.state", load()
    render(scene, integrator(passes=1), 2, checkpoint=Checkpoint(path))
    state = State.load(path)
    errors, focus = {"none": None, "global": 1 / 3}, Focus((1.0, 2.0, 1 / 3), 0.7)
    per_pixel = numbers, pixels.astype(np.uint32), numbers / 7
    for kept in (
        Settled("caustic", errors, 7, 1 / 7, 3, few, None, few, None, 0.25),
        Settled("none", {}, 0, 0.1, 1, *per_pixel, aimed, 0.0, focus, ("lamp",)),
    ):
        replace(state, settled=kept).save(path)
        loaded = State.load(path).settled
        assert_same_choice(loaded, kept)


def test_resuming_a_time_budget_counts_what_was_spent(tmp_path):
    path = tmp_path / "a.state"
    scene = load()
    render(scene, integrator(passes=2), 4, checkpoint=Checkpoint(path))
    state = State.load(path)
    state.seconds = 100.0
    state.save(path)
    plugin = integrator(time=50.0)
    render(scene, plugin, 2, checkpoint=Checkpoint(path, resume=True))
    assert plugin.statistics["passes"] == 2


@pytest.mark.parametrize(
    "change, named",
    [
        ({"rule": "taylor"}, 'parameter "rule" was lobe, is taylor'),
        ({"photon_count": 3001}, "photon count was 3000, is 3001"),
        ({"initial_radius": 0.2}, "initial radius was 0.15, is 0.2"),
        ({"hide_emitters": True}, 'parameter "hide_emitters" was False, is True'),
    ],
)
def test_other_parameters_are_refused_by_name(states, change, named):
    paths, scene, _ = states
    with pytest.raises(StateError, match=named):
        render(scene, integrator(passes=4, **change), 8, checkpoint=Checkpoint(paths[0], 30, True))


@pytest.mark.parametrize(
    "options, named",
    [
        ({"seed": 2}, "seed was 1, is 2"),
        ({"spp": 12}, "samples per pass was 2, is 3"),
        ({"first_pass": 1}, "holds passes 0-1, but passes 1-4 are asked for"),
    ],
)
def test_other_passes_are_refused_by_name(states, options, named):
    paths, scene, _ = states
    options = {"spp": 8, "seed": 1, "first_pass": 0} | options
    with pytest.raises(StateError, match=named):
        render(scene, integrator(passes=4), checkpoint=Checkpoint(paths[0], 30, True), **options)


def _brighter(definition):
    definition["light"]["emitter"]["radiance"]["value"] = [8, 7.5, 7.1]


def _moved(definition):
    T = mi.ScalarTransform4f
    definition["floor"]["to_world"] = T().translate([0, 1e-4, 0]) @ definition["floor"]["to_world"]


def _other_distribution(definition):
    definition["plate"]["bsdf"]["bsdf"]["distribution"] = "ggx"


def _without(definition):
    del definition["left"]


def _turned(definition):
    definition["sensor"]["fov"] = 75.01


def _cropped(definition):
    definition["sensor"]["film"] |= {"width": 9}


@pytest.mark.parametrize(
    "change, named",
    [
        (_brighter, "scene, light has changed"),
        (_moved, "scene, floor has changed"),
        (_other_distribution, "scene, plate has changed"),
        (_without, "scene, left is only in the other one"),
        (_turned, "camera has changed"),
        (_cropped, "film size was 8x8, is 9x8"),
    ],
)
def test_another_scene_is_refused_by_what_changed(states, change, named):
    paths, _, _ = states
    definition = room_with_plate(8)
    change(definition)
    scene = mi.load_dict(definition, optimize=False)
    with pytest.raises(StateError, match=named):
        render(scene, integrator(passes=4), 8, checkpoint=Checkpoint(paths[0], 30, True))


def test_the_same_scene_is_recognised_whatever_the_order_of_its_objects(states):
    """Meshes are merged in the order of their addresses, and computed normals are sums in the
    order of threads: neither is a different scene."""
    from aniso_pm.rendering.digest import scene_entries

    definition = room_with_plate(8)
    backwards = dict(reversed(definition.items()))
    first, second = (mi.load_dict(d, optimize=False) for d in (definition, backwards))
    assert scene_entries(first) == scene_entries(second)
    assert len(scene_entries(first)) == 8


def test_a_texture_is_part_of_the_scene(tmp_path):
    from aniso_pm.rendering.digest import scene_entries

    def entries(value):
        data = mi.TensorXf(np.full((4, 4, 3), value, dtype=np.float32))
        texture = {"type": "bitmap", "data": data, "raw": True}
        bsdf = {"type": "diffuse", "reflectance": texture}
        return scene_entries(mi.load_dict({"type": "scene", "a": {"type": "sphere", "bsdf": bsdf}}))

    assert entries(0.5) == entries(0.5) != entries(0.50001)


def test_overlapping_and_foreign_states_do_not_merge(states):
    paths, scene, _ = states
    a, b = (State.load(path) for path in paths)
    with pytest.raises(StateError, match="c: pass 0 is already"):
        merge({"a": a, "b": b, "c": a})
    other = State.load(paths[1])
    other.identity["seed"] = 9
    with pytest.raises(StateError, match="b and a.*seed was 9, is 1"):
        merge({"a": a, "b": other})
    assert describe([[0, 8], [16, 17]]) == "0-7, 16"


def test_damaged_states_are_never_read_as_data(states):
    """Truncated anywhere, any bit flipped (but for bits that zip does not use), or not a state."""
    path = states[0][0]
    data = path.read_bytes()
    whole = State.load(path)
    rng = np.random.default_rng(0)
    for length in [0, 1, 100, len(data) - 1, *rng.integers(0, len(data), 40)]:
        path.write_bytes(data[:length])
        with pytest.raises(StateError, match="not a whole state file"):
            State.load(path)
    refused = 0
    for position in rng.integers(0, len(data), 200):
        flipped = bytearray(data)
        flipped[position] ^= 1 << int(rng.integers(8))
        path.write_bytes(flipped)
        try:
            state = State.load(path)
        except StateError:
            refused += 1
            continue
        # Time stamps and attributes of the archive: what is read is what was written.
        assert state.identity == whole.identity and state.passes == whole.passes
        assert all((state.arrays[k] == whole.arrays[k]).all() for k in whole.arrays)
    assert refused > 150


def test_a_consistent_archive_with_a_changed_value_is_refused(states):
    path = states[0][0]
    with np.load(path) as archive:
        content = dict(archive)
    content["first"][0, 0, 0] += 1
    with open(path, "wb") as file:
        np.savez(file, **content)
    with pytest.raises(StateError, match="checksum"):
        State.load(path)
    content["header"] = np.array(json.dumps(json.loads(str(content["header"])) | {"version": 99}))
    with open(path, "wb") as file:
        np.savez(file, **content)
    with pytest.raises(StateError, match="format 99"):
        State.load(path)


def test_state_and_picture_are_saved_on_the_way(tmp_path):
    path = tmp_path / "a.state"
    written = []
    plugin = integrator(passes=5)
    hook = lambda: written.append(State.load(path).passes)  # noqa: E731
    render(load(), plugin, 5, checkpoint=Checkpoint(path, 0.0, on_write=hook))
    # Saving may take no more than a twentieth of the time: not necessarily after every pass.
    assert written and written[0][0][0] == 0
    assert State.load(path).passes == [[0, 5]]
    assert [p.name for p in Path(tmp_path).iterdir()] == ["a.state"]


def test_what_others_do_with_the_picture_on_the_way_takes_no_time(tmp_path, monkeypatch, ticking):
    monkeypatch.setattr(dr, "kernel_history", list)  # what is compiled here takes no time
    plugin, written = integrator(passes=0, time=1.0), []

    def write():
        written.append(plugin.statistics["passes"])
        ticking(100)

    checkpoint = Checkpoint(tmp_path / "a.state", 0.0, on_write=write)
    render(load(), plugin, 5, checkpoint=checkpoint)
    assert plugin.statistics["passes"] > written[0]
    assert State.load(tmp_path / "a.state").seconds == pytest.approx(1, abs=0.2)


def test_checkpoints_of_films_with_alpha_crop_and_other_colours(tmp_path):
    definition = room(size=8)
    definition["sensor"]["film"] |= {"pixel_format": "luminance_alpha", "crop_width": 5}
    scene = mi.load_dict(definition, optimize=False)
    path = tmp_path / "a.state"
    image = render(scene, integrator(passes=2), 4, checkpoint=Checkpoint(path))
    state = State.load(path)
    from aniso_pm.rendering import film as films

    film = films.from_description(state.film)
    films.show_array(film, state.arrays["first"])
    assert image.shape == (8, 5, 2)
    close(np.array(film.develop()), image)
    assert state.variance().shape == (8, 5, 4)


@pytest.mark.parametrize("rfilter, least", [("gaussian", 0.0), ("lanczos", -1.0)])
def test_films_of_states_keep_what_their_filter_leaves_below_zero(rfilter, least):
    from aniso_pm.rendering import film as films

    whole = {"type": "hdrfilm", "width": 2, "height": 2, "rfilter": {"type": rfilter}}
    film = films.from_description(films.describe(mi.load_dict(whole)))
    sums = np.ones((2, 2, film.create_block().channel_count()))
    sums[0, 0, :3] = -1
    films.show_array(film, sums)
    assert np.array(film.develop())[0, 0, :3] == pytest.approx(least)


def test_lights_without_shape_and_instanced_shapes_are_part_of_the_scene():
    def entries(intensity=1.0, reflectance=0.5, radius=0.3):
        ball = {"type": "sphere", "radius": radius, "bsdf": {"type": "diffuse"}}
        ball["bsdf"]["reflectance"] = {"type": "rgb", "value": reflectance}
        parts = {
            "group": {"type": "shapegroup", "ball": ball},
            "instance": {"type": "instance", "group": {"type": "ref", "id": "group"}},
            "lamp": {"type": "point", "position": [0, 0.5, 0.5], "intensity": intensity},
        }
        return scene_entries(mi.load_dict(room_with_plate(8) | parts))

    assert differences(entries(), entries()) == []
    assert differences(entries(), entries(intensity=2.0)) == ["scene, lamp has changed"]
    for change in ({"reflectance": 0.4}, {"radius": 0.2}):
        assert differences(entries(), entries(**change)) == ["scene, ball has changed"]


def test_a_checkpoint_takes_its_path_as_text(tmp_path):
    path = str(tmp_path / "a.state")
    render(load(8), integrator(passes=2), 4, checkpoint=Checkpoint(path))
    assert State.load(path).passes == [[0, 2]]
