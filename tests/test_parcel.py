"""A scene travels with all its files, unpacks below one folder only, and loads as the same."""

import io
import tarfile
from pathlib import Path

import aniso_pm  # noqa: F401
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.distributed.parcel import BadParcel, Parcel
from aniso_pm.errors import InputError
from aniso_pm.rendering.digest import camera_entries, differences, scene_entries
from rooms import room_with_ball


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


def picture(path, seed=0, size=4):
    values = np.random.default_rng(seed).random((size, size, 3)).astype(np.float32)
    path.parent.mkdir(parents=True, exist_ok=True)
    mi.Bitmap(values).write(str(path))
    return path


# Everything that a scene may name in another place, in as many ways.
MAIN = """<scene version="3.0.0">
  <default name="where" value="parts"/>
  <default name="wherever" value="nowhere"/>
  <path value="more"/>
  <integrator type="aniso_pm"><integer name="photon_count" value="3000"/></integrator>
  <sensor type="perspective">
    <transform name="to_world"><lookat origin="0, 2, 4" target="0, 0, 0" up="0, 1, 0"/></transform>
    <film type="hdrfilm"><integer name="width" value="12"/><integer name="height" value="9"/></film>
  </sensor>
  <include filename="$where/materials.xml"/>
  <shape type="obj" id="floor">
    <string name="filename" value="../shared/flo$letterr.obj"/>
    <ref id="wood"/>
  </shape>
  <shape type="sphere" id="ball">
    <bsdf type="roughconductor">
      <spectrum name="specular_reflectance" filename="red.spd"/> <float name="alpha" value="0.05"/>
    </bsdf>
  </shape>
  <emitter type="envmap"><string name="filename" value="{absolute}"/></emitter>
</scene>
"""
MATERIALS = """<scene version="3.0.0">
  <bsdf type="diffuse" id="wood">
    <texture type="bitmap" name="reflectance">
      <string name="filename" value="parts/wood &amp; glue.png"/>
    </texture>
  </bsdf>
</scene>
"""


@pytest.fixture
def spread(tmp_path):
    """A scene whose files lie in five folders."""
    home = tmp_path / "home"
    picture(home / "parts" / "wood & glue.exr")
    mi.Bitmap(str(home / "parts" / "wood & glue.exr")).convert(
        mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.UInt8, True
    ).write(str(home / "parts" / "wood & glue.png"))
    (home / "parts" / "materials.xml").write_text(MATERIALS)
    (home / "more").mkdir()
    (home / "more" / "red.spd").write_text("400 0.1\n700 0.9\n")
    (tmp_path / "shared").mkdir()
    corners = "v -2 -1 -2\nv 2 -1 -2\nv 2 -1 2\nv -2 -1 2\n"
    texture = "vt 0 0\nvt 1 0\nvt 1 1\nvt 0 1\n"
    (tmp_path / "shared" / "floor.obj").write_text(
        corners + texture + "f 1/1 3/3 2/2\nf 1/1 4/4 3/3\n"
    )
    absolute = picture(tmp_path / "lights" / "sky.exr", 1, 8)
    scene = home / "scene of mine.xml"
    scene.write_text(MAIN.replace("{absolute}", str(absolute)))
    return scene


def entries(world):
    return scene_entries(world) | camera_entries(world.sensors()[0])


def assert_same_scene(a, b):
    assert differences(entries(a), entries(b)) == []


def test_a_scene_loads_as_the_same_from_its_parcel_alone(spread, tmp_path, monkeypatch):
    defines = {"letter": "o"}
    here = mi.load_file(str(spread), optimize=False, **defines)
    parcel = Parcel.of(spread, defines)
    places = sorted(Path(path).name for path in parcel.sources.values())
    assert places == [
        "floor.obj",
        "materials.xml",
        "red.spd",
        "scene of mine.xml",
        "sky.exr",
        "wood & glue.png",
    ]
    for path in set(parcel.sources.values()):
        Path(path).unlink()
    (tmp_path / "elsewhere").mkdir()
    monkeypatch.chdir(tmp_path / "elsewhere")
    there = parcel.load(tmp_path / "worker")
    assert_same_scene(here, there)
    assert list((tmp_path / "worker").iterdir()) == []  # nothing stays


def test_a_changed_texture_is_another_parcel(spread):
    first = Parcel.of(spread, {"letter": "o"})
    assert Parcel.of(spread, {"letter": "o"}).sha256 == first.sha256
    picture(spread.parent.parent / "lights" / "sky.exr", 2, 8)
    assert Parcel.of(spread, {"letter": "o"}).sha256 != first.sha256


@pytest.mark.parametrize(
    "missing, parts",
    [
        ("lights/sky.exr", ["scene of mine.xml", '<emitter type="envmap">', "sky.exr"]),
        ("home/parts/materials.xml", ["scene of mine.xml", "<include>", "parts/materials.xml"]),
        ("home/parts/wood & glue.png", ["materials.xml", '<texture type="bitmap">', "wood & glue"]),
        ("home/more/red.spd", ["scene of mine.xml", "<spectrum>", "red.spd"]),
        ("shared/floor.obj", ['<shape type="obj" id="floor">', "../shared/floor.obj"]),
    ],
)
def test_a_missing_file_is_named_with_the_element_that_wants_it(spread, tmp_path, missing, parts):
    (tmp_path / missing).unlink()
    with pytest.raises(InputError) as error:
        Parcel.of(spread, {"letter": "o"})
    for part in [*parts, "not there"]:
        assert part in str(error.value)


def archive(*members):
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as tar:
        for name, kind in members:
            member = tarfile.TarInfo(name)
            member.type = kind
            member.linkname = "/etc/passwd"
            member.size = 3 if kind == tarfile.REGTYPE else 0
            tar.addfile(member, io.BytesIO(b"abc"))
    return buffer.getvalue()


@pytest.mark.parametrize(
    "name, kind",
    [
        ("../x", tarfile.REGTYPE),
        ("0/../x", tarfile.REGTYPE),
        ("0/..", tarfile.REGTYPE),
        ("/elsewhere/x", tarfile.REGTYPE),
        ("0/a/b", tarfile.REGTYPE),
        ("..\\x", tarfile.REGTYPE),
        ("x.txt", tarfile.REGTYPE),
        ("0/x", tarfile.SYMTYPE),
        ("0/x", tarfile.LNKTYPE),
        ("scene.xml", tarfile.SYMTYPE),
        ("0/x", tarfile.FIFOTYPE),
        ("0", tarfile.DIRTYPE),
    ],
)
def test_what_would_unpack_elsewhere_is_refused(tmp_path, name, kind):
    import hashlib

    data = archive(("0/good", tarfile.REGTYPE), (name, kind))
    sha = hashlib.sha256(data).hexdigest()
    parcel = Parcel(np.frombuffer(data, np.uint8), sha, None, {}, {})
    place = tmp_path / "worker"
    with pytest.raises(BadParcel, match="refused"), parcel.unpacked(place):
        pass
    assert [path for path in tmp_path.rglob("*") if path != place] == []


def test_a_parcel_that_was_damaged_on_the_way_is_refused(tmp_path):
    data = archive(("0/good", tarfile.REGTYPE))
    parcel = Parcel(np.frombuffer(data[:-1], np.uint8), "0" * 64, None, {}, {})
    with pytest.raises(BadParcel, match="damaged"), parcel.unpacked(tmp_path):
        pass


def test_scenes_given_as_dictionaries_travel_with_what_they_hold(tmp_path, monkeypatch):
    values = np.random.default_rng(3).random((4, 4, 3)).astype(np.float32)
    picture(tmp_path / "here" / "sky.exr", 1, 8)
    monkeypatch.chdir(tmp_path / "here")
    scene = room_with_ball(8) | {
        "sky": {"type": "envmap", "filename": "sky.exr", "scale": np.float32(0.5)},
        "card": {
            "type": "rectangle",
            "to_world": mi.ScalarTransform4f().translate(mi.ScalarPoint3f(0, 0.1, 0)).scale(0.2),
            "bsdf": {
                "type": "diffuse",
                "reflectance": {"type": "bitmap", "data": mi.TensorXf(values), "raw": True},
            },
        },
        "other": {
            "type": "sphere",
            "center": mi.ScalarPoint3f(0.2, 0.3, 0.4),
            "radius": 0.1,
            "bsdf": {
                "type": "diffuse",
                "reflectance": {"type": "bitmap", "bitmap": mi.Bitmap(values)},
            },
        },
    }
    parcel = Parcel.of(scene)  # first: Mitsuba makes tensors flat that it has taken
    here = mi.load_dict(scene, optimize=False)
    (tmp_path / "here" / "sky.exr").unlink()
    monkeypatch.chdir(tmp_path)
    assert_same_scene(here, parcel.load(tmp_path / "worker"))


def test_dictionaries_name_what_is_missing_and_what_cannot_travel():
    with pytest.raises(InputError, match=r"'sky\.filename' names the file 'no\.exr'"):
        Parcel.of({"type": "scene", "sky": {"type": "envmap", "filename": "no.exr"}})
    loaded = mi.load_dict({"type": "sphere"})
    with pytest.raises(InputError, match=r"'a\.ball' is a Shape.*describe it by a dictionary"):
        Parcel.of({"type": "scene", "a": {"type": "merge", "ball": loaded}})
