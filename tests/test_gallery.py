"""The gallery is copied whole, and every scene of it has a reference that still belongs to it."""

import json

import aniso_pm  # noqa: F401
import mitsuba as mi
import pytest
from aniso_pm import cli
from aniso_pm.instruments import gallery
from aniso_pm.instruments.report import reference as references

NAMES = [
    "brushed_tray",
    "brushed_wall",
    "far_close",
    "fry_pan",
    "glass_balls",
    "plain_room",
    "teapot",
]
# Sizes that reports use, where they are not the scene's own
SMALL = {name: {"width": "160", "height": "120"} for name in ("teapot", "fry_pan")}


@pytest.fixture
def run(capfd):
    def run(*arguments):
        status = cli.main(["scenes", *(str(argument) for argument in arguments)])
        return status, *capfd.readouterr()

    return run


def test_every_scene_says_what_it_is_for():
    assert [scene.name for scene in gallery.scenes()] == NAMES
    for scene in gallery.scenes():
        assert len(scene.about) > 60 and scene.about.endswith(".")


@pytest.mark.parametrize("name", NAMES)
def test_a_copy_of_each_scene_finds_its_reference(name, tmp_path, own_cache, variant_llvm_rgb):
    """Wherever it is copied to; and whoever changes a scene has to make its reference again."""
    gallery.copy(tmp_path / "copy")
    file = tmp_path / "copy" / f"{name}.xml"
    world = mi.load_file(str(file), optimize=False, **SMALL.get(name, {}))
    found = references.find(file, world, world.sensors()[0])
    assert found is not None, f"scenes/references has none that belongs to {name}.xml"
    assert found.own_error < 0.02
    assert found.path.stat().st_size < 2**20


def test_the_command_copies_once_and_overwrites_on_demand_only(run, tmp_path):
    target = tmp_path / "new" / "gallery"
    status, said, _ = run(target)
    assert status == 0 and f"aniso-pm render {target}" in said
    changed = target / "teapot.xml"
    original = changed.read_bytes()
    changed.write_text("mine")
    status, _, error = run(target)
    assert status == 2 and "already there" in error and "--force" in error
    assert changed.read_text() == "mine"
    status, said, _ = run(target, "--force", "--json")
    assert status == 0 and changed.read_bytes() == original
    listed = json.loads(said)["scenes"]
    assert [scene["file"] for scene in listed] == [str(target / f"{name}.xml") for name in NAMES]


def test_the_command_lists_without_copying_and_refuses_the_rest(run, tmp_path):
    status, said, _ = run("--list")
    assert status == 0 and all(f"{name}: " in said for name in NAMES)
    (tmp_path / "file").write_text("")
    for arguments, message in (
        ((), "name a directory"),
        ((tmp_path, "--list"), "name a directory"),
        ((tmp_path / "file" / "deeper",), "cannot write"),
    ):
        status, _, error = run(*arguments)
        assert status == 2 and message in error and error.count("\n") == 1
