"""What is found out about a scene, and what is left out because of it."""

import json

import matrix
import mitsuba as mi
import pytest
from aniso_pm import cli
from aniso_pm.instruments import inspect
from aniso_pm.map.receivers import has_walked_part, may_gather
from aniso_pm.rendering.prepared import prepare
from aniso_pm.rendering.settings import Settings


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


def findings(name, **settings):
    scene = matrix.make(matrix.rows()[name], size=4)
    return {
        f.name: f
        for f in inspect.examine(prepare(scene, Settings(**{"map": "global"} | settings), False))
    }


def test_a_diffuse_room_needs_nothing_but_the_map():
    found = findings("area, diffuse")
    assert [name for name, f in found.items() if f.needed] == [
        "photon map",
        "edge compensation",
        "bytes per photon",
    ]


def test_without_caustics_a_caustic_map_is_no_map():
    found = findings("area, diffuse", map="caustic")
    assert not found["photon map"].needed and "path traced" in found["photon map"].consequence
    scene = matrix.make(matrix.rows()["area, diffuse"], size=4)
    integrator = mi.load_dict({"type": "aniso_pm", "map": "caustic"})
    mi.render(scene, integrator=integrator, spp=1)
    assert integrator.statistics["photons_emitted"] == 0


def test_auto_says_what_it_chose_and_why():
    none = findings("area, diffuse", map="auto")["photon map"]
    assert not none.needed and none.evidence[0] == "map=auto: nothing casts caustics"
    found = findings("brushed conductor", map="auto")["photon map"]
    words = found.evidence[0].removeprefix("map=auto: relative MSE that a pilot promises: ")
    promises = dict(word.split(maxsplit=1) for word in words.split(", "))
    numbers = {use: float(text) for use, text in promises.items() if text[0].isdigit()}
    assert "global" in numbers
    chosen = found.consequence.split(":")[0] if found.needed else "none"
    assert numbers[chosen] <= 1.2 * min(numbers.values())
    assert "map=auto" not in str(findings("brushed conductor")["photon map"].evidence)


def test_what_is_gathered_as_a_whole_casts_no_caustics():
    bumped = matrix.rows()["tilted diffuse floor under a spot"]
    scene = matrix.make(bumped, size=4)
    found = prepare(scene, Settings(map="caustic"), False)
    assert not found.needs_map and found.needs.bent


def test_a_clearcoat_is_a_smooth_lobe():
    objects = matrix.ball({"type": "principled", "roughness": 0.8, "clearcoat": 0.5})
    scene = matrix.make(matrix.Row(objects=objects), size=4)
    assert not prepare(scene, Settings(), False).needs.general


def test_a_readable_part_does_not_hide_an_unreadable_one():
    blend = {"type": "blendbsdf", "weight": 0.5, "a": {"type": "roughconductor"}}
    objects = matrix.ball(blend | {"b": {"type": "hair"}})
    scene = matrix.make(matrix.Row(objects=objects), size=4)
    assert len(prepare(scene, Settings(), False).needs.unreadable) == 1


def test_evidence_names_shape_and_nested_bsdfs():
    plate = "plate: TwoSidedBRDF(RoughConductor)"
    found = findings("brushed conductor", kernel="anisotropic")
    assert found["anisotropic lobes"].needed and found["anisotropic lobes"].evidence == [plate]
    found = findings("brushed conductor")  # near by, nothing would be gained
    assert not found["anisotropic lobes"].needed
    why, surface = found["anisotropic lobes"].evidence
    assert why.startswith("kernel=auto: kernels behind lobes make ") and surface == plate
    found = findings("brushed conductor", kernel="isotropic")
    assert not found["anisotropic lobes"].needed
    assert found["anisotropic lobes"].evidence == ["parameter kernel=isotropic"]


def instance_of(bsdf):
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {"type": "perspective"},
            "light": {"type": "constant"},
            "floor": {"type": "rectangle", "id": "floor"},
            "balls": {"type": "shapegroup", "ball": {"type": "sphere", "bsdf": bsdf}},
            "one": {"type": "instance", "group": {"type": "ref", "id": "balls"}},
            "two": {"type": "instance", "group": {"type": "ref", "id": "balls"}},
        }
    )


def test_what_lies_in_instances_is_inspected_once():
    needs = prepare(instance_of({"type": "dielectric"}), Settings(), False).needs
    assert needs.chains == ["ball in balls: SmoothDielectric"]
    assert needs.receivers == ["floor: SmoothDiffuse"] and not needs.lobes


def test_instances_of_diffuse_things_need_no_more_than_these():
    needs = prepare(instance_of({"type": "diffuse"}), Settings(), False).needs
    assert len(needs.receivers) == 2
    assert not (needs.general or needs.chains or needs.lobes or needs.bent)


@pytest.mark.parametrize(
    "row, general",
    [
        ("roughconductor 0.4", True),
        ("roughconductor 0.1", False),
        ("roughplastic 0.1", True),  # its diffuse component
        ("principled", True),
        ("dielectric", False),
        ("hair", False),
        ("textured roughness", True),
        ("mask of diffuse", True),
    ],
)
def test_receivers_are_what_is_rough_or_diffuse(row, general):
    scene = matrix.make(matrix.rows()[row], size=4)
    assert bool(prepare(scene, Settings(), False).needs.general) == general


@pytest.mark.parametrize("texture, gathers", [("base_color", False), ("roughness", True)])
def test_only_textures_of_roughness_make_it_vary(texture, gathers):
    bsdf = mi.load_dict(
        {"type": "principled", "roughness": 0.3} | {texture: {"type": "checkerboard"}}
    )
    assert may_gather(bsdf, 0.3) == gathers
    assert has_walked_part(bsdf, 0.3)


def test_roughness_that_cannot_be_read_is_named():
    assert findings("hair")["unreadable roughness"].evidence == ["ball: Hair"]


def test_the_threshold_is_a_parameter():
    assert not findings("roughconductor 0.4", gather_roughness=0.5)["general receivers"].needed
    assert findings("roughconductor 0.1", gather_roughness=0.05)["general receivers"].needed


def test_the_command_prints_the_same_as_text_and_json(tmp_path, capsys):
    scene = tmp_path / "s.xml"
    scene.write_text(
        '<scene version="3.0.0"><sensor type="perspective"/><integrator type="aniso_pm"/>'
        '<emitter type="point"/><shape type="sphere" id="s"><bsdf type="plastic"/></shape></scene>'
    )
    assert cli.main(["inspect", str(scene), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert {"name", "needed", "consequence", "evidence"} == set(told[0])
    assert cli.main(["inspect", str(scene)]) == 0
    text = capsys.readouterr().out
    assert "s: SmoothPlastic" in text and "PointLight" in text
    assert cli.main(["inspect", str(tmp_path / "none.xml")]) == 2


def test_what_is_left_out_is_not_compiled():
    def sizes(name, **settings):
        scene = matrix.make(matrix.rows()[name], size=4)
        found = inspect.kernels(prepare(scene, Settings(**{"map": "global"} | settings), False))
        lines = (line.split() for line in found.evidence)
        return {words[0]: int(words[3].replace(",", "")) for words in lines}

    plain = sizes("area, diffuse")
    assert list(plain) == ["photons:", "index:", "eye:", "gather:"]
    assert all(size > 100 for size in plain.values())
    assert sizes("area, diffuse", kernel="isotropic") == plain
    assert sizes("area, diffuse", edge_compensation=False)["gather:"] < plain["gather:"]
    # No map, no photons, and nothing to gather
    assert list(sizes("area, diffuse", map="caustic")) == ["eye:", "gather:"]
