"""What is told about a pixel is what the integrator does, and what geometry says."""

import json

import matrix
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm import cli
from aniso_pm.instruments.explain import explain
from rooms import room, room_with_plate

OURS = {"type": "aniso_pm", "map": "global", "photon_count": 20_000, "initial_radius": 0.15}


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


def explained(definition, pixel, *, sample=None, samples=64, pass_index=0, **parameters):
    integrator = mi.load_dict(OURS | parameters)
    scene = mi.load_dict(definition)
    options = {"sample": sample, "samples": samples, "pass_index": pass_index}
    return explain(scene, pixel, integrator, **options)


def plate_seen_straight_on(alpha_u=0.05, alpha_v=0.2, bsdf=None):
    """An orthographic camera looks straight down at a brushed plate; behind the camera, 2 above
    the plate, hangs a diffuse sheet that is lit by way of the floor."""
    T = mi.ScalarTransform4f
    brushed = {"type": "roughconductor", "alpha_u": alpha_u, "alpha_v": alpha_v}
    return {
        "type": "scene",
        "sensor": {
            "type": "orthographic",
            "to_world": T().look_at(origin=[0, 0, 1], target=[0, 0, 0], up=[0, 1, 0]).scale(0.2),
            "film": {"type": "hdrfilm", "width": 4, "height": 3},
        },
        "plate": {"type": "rectangle", "bsdf": bsdf or brushed},
        "sheet": {
            "type": "rectangle",
            "to_world": T().translate([0, 0, 2]).rotate([1, 0, 0], 180).scale(4),
        },
        "floor": {"type": "rectangle", "to_world": T().translate([0, 0, -1]).scale(6)},
        "light": {"type": "point", "position": [3, 3, 1]},
    }


def test_the_lobe_is_that_of_the_plate_at_normal_incidence():
    found = explained(plate_seen_straight_on(0.05, 0.2), (1, 1))
    lobe, kernel = found.lobe, found.kernel
    # dr/dh = 2 in every direction: α² in half-vectors is 4α² in directions.
    assert lobe.lam == pytest.approx(1 / (4 * 0.05**2), rel=1e-3)
    assert lobe.mu == pytest.approx(1 / (4 * 0.2**2), rel=1e-3)
    np.testing.assert_allclose(np.abs(lobe.x), [1, 0, 0], atol=1e-3)
    np.testing.assert_allclose(lobe.z, [0, 0, 1], atol=1e-5)
    assert kernel.follows_lobe and found.sentence.startswith("kernel of aspect")
    # Long along the rough direction, y.
    assert abs(kernel.s[1]) > 0.99 * np.linalg.norm(kernel.s)
    assert kernel.area == pytest.approx(np.pi * 0.15**2, rel=1e-3)
    r = np.array(lobe.r)
    expected = (2 * lobe.lam * r[0] ** 2 + 2 * lobe.mu * r[1] ** 2) ** 0.5
    assert lobe.off == pytest.approx(expected, rel=0.05)


def test_the_path_is_told_vertex_by_vertex():
    found = explained(plate_seen_straight_on(), (2, 1))
    plate, sheet = found.path
    assert plate.shape == "plate [RoughConductor]" and sheet.shape == "sheet [SmoothDiffuse]"
    assert (plate.depth, sheet.depth) == (1, 2)
    assert plate.scatters == "glossy reflection" and not plate.gathers and sheet.gathers
    assert plate.roughness == pytest.approx((0.05, 0.2)) and sheet.roughness is None
    assert plate.p[2] == pytest.approx(0, abs=1e-5) and sheet.p[2] == pytest.approx(2, abs=1e-5)
    step = np.subtract(sheet.p, plate.p)
    np.testing.assert_allclose(step / np.linalg.norm(step), found.lobe.r, atol=1e-4)
    assert found.lobe.distance == pytest.approx(np.linalg.norm(step), rel=1e-4)


def test_what_lies_in_instances_is_named():
    scene = plate_seen_straight_on()
    scene["group"] = {"type": "shapegroup", "plate": scene.pop("plate")}
    scene["copy"] = {"type": "instance", "group": {"type": "ref", "id": "group"}}
    plate, _ = explained(scene, (2, 1)).path
    assert plate.shape == "plate in group [RoughConductor]"


@pytest.mark.parametrize("map_, tolerance", [("global", 0.0), ("global", 0.9), ("caustic", 0.0)])
def test_photons_inside_are_those_that_geometry_puts_there(map_, tolerance):
    options = {"map": map_, "gather_tolerance": tolerance, "photon_count": 60_000}
    found = explained(room_with_plate(16), (7, 12), **options)
    photons, kernel = found.photons, found.kernel
    long, short = np.linalg.norm(kernel.s), np.linalg.norm(kernel.t)
    rho2 = (photons.xy[:, 0] / long) ** 2 + (photons.xy[:, 1] / short) ** 2
    expected = photons.facing & (rho2 <= 4)
    assert found.photons_inside == photons.counted.sum() > 5
    # Those within rounding of the border may fall on either side.
    sure = np.abs(rho2 - 4) > 1e-4
    np.testing.assert_array_equal(photons.counted[sure], expected[sure])
    np.testing.assert_allclose(photons.weight, np.where(photons.counted, np.exp(-rho2), 0))


def test_the_maps_radiance_is_what_rendering_adds_to_direct_light():
    definition = room(size=6)
    scene = mi.load_dict(definition)

    def render(**parameters):
        plugin = mi.load_dict(OURS | {"photon_count": 300_000} | parameters)
        return np.array(mi.render(scene, integrator=plugin, spp=8192, seed=0))

    indirect = render() - render(max_depth=2)
    for pixel in ((1, 4), (4, 2)):
        found = explained(definition, pixel, photon_count=300_000, samples=8192)
        # Photons of the same pass: what differs is where in the pixel the eye samples are.
        np.testing.assert_allclose(found.pixel_radiance, indirect[pixel[1], pixel[0]], rtol=0.03)


def test_later_passes_have_smaller_kernels_and_other_photons():
    first, third = (explained(room(size=4), (1, 1), pass_index=i) for i in (0, 2))
    # r² shrinks by (i + α)/(i + 1).
    expected = ((1 + 2 / 3) / 2 * (2 + 2 / 3) / 3) ** 0.5
    assert third.radius / first.radius == pytest.approx(expected)
    assert third.photons_inside != first.photons_inside


def test_the_same_seed_explains_the_same():
    a, b = (explained(room_with_plate(16), (7, 12)) for _ in range(2))
    assert (a.sample, a.photons_inside, a.path) == (b.sample, b.photons_inside, b.path)


def test_a_sample_may_be_chosen():
    found = explained(plate_seen_straight_on(), (1, 1), sample=5)
    assert found.sample == 5
    with pytest.raises(ValueError, match="sample 64 is not one of 0 to 63"):
        explained(plate_seen_straight_on(), (1, 1), sample=64)


@pytest.mark.parametrize(
    "parameters, bsdf, words",
    [
        ({"kernel": "isotropic"}, None, "kernel=isotropic"),
        ({}, {"type": "conductor"}, "no anisotropic surface"),
        ({}, {"type": "diffuse"}, "no anisotropic surface"),
        ({"max_depth": 2}, None, "needs no photon map"),
        ({"max_depth": 3}, None, "no eye path reads the photon map"),
        ({"map": "caustic"}, {"type": "diffuse"}, "needs no photon map"),
    ],
)
def test_what_is_not_anisotropic_is_told_in_a_sentence(parameters, bsdf, words):
    found = explained(plate_seen_straight_on(bsdf=bsdf), (1, 1), **parameters)
    assert words in found.sentence
    assert found.kernel is None or not found.kernel.follows_lobe
    assert json.loads(json.dumps(found.data()))["sentence"] == found.sentence
    assert found.sentence in str(found) and found.sentence in found._repr_html_()


def test_a_pixel_without_surface_says_so():
    definition = plate_seen_straight_on()
    for name in ("plate", "sheet", "floor"):
        del definition[name]
    assert "sees no surface" in explained(definition, (1, 1)).sentence


@pytest.mark.parametrize("variant", ["llvm_ad_mono", "llvm_ad_spectral"])
def test_other_variants_are_explained_too(variant):
    before = mi.variant()
    mi.set_variant(variant)
    found = explained(plate_seen_straight_on(), (1, 1))
    assert found.kernel.follows_lobe and max(found.contribution) >= 0
    assert len(found.contribution) == (1 if variant == "llvm_ad_mono" else 4)
    mi.set_variant(before)


def test_rough_receivers_and_chains_are_explained():
    scene = matrix.make(matrix.rows()["roughconductor 0.4"], size=8)
    film = scene.sensors()[0].film().size()
    found = explain(scene, (film[0] // 2, film[1] // 2), mi.load_dict(OURS), samples=16)
    assert found.gather_points >= found.samples and any(v.gathers for v in found.path)


# --- The command ---


XML = """<scene version="3.0.0">
  <integrator type="aniso_pm">
    <integer name="photon_count" value="20000"/> <float name="initial_radius" value="0.15"/>
  </integrator>
  <sensor type="orthographic">
    <transform name="to_world">
      <scale value="0.2"/> <lookat origin="0, 0, 1" target="0, 0, 0" up="0, 1, 0"/>
    </transform>
    <film type="hdrfilm">
      <integer name="width" value="4"/> <integer name="height" value="3"/>
    </film>
  </sensor>
  <shape type="rectangle" id="plate">
    <bsdf type="roughconductor">
      <float name="alpha_u" value="0.05"/> <float name="alpha_v" value="0.2"/>
    </bsdf>
  </shape>
  <shape type="rectangle" id="sheet">
    <transform name="to_world">
      <scale value="4"/> <rotate x="1" angle="180"/> <translate z="2"/>
    </transform>
  </shape>
  <shape type="rectangle" id="floor">
    <transform name="to_world"> <scale value="6"/> <translate z="-1"/> </transform>
  </shape>
  <emitter type="point"><point name="position" value="3, 3, 1"/></emitter>
</scene>
"""


@pytest.fixture
def xml(tmp_path):
    path = tmp_path / "plate.xml"
    path.write_text(XML)
    return path


@pytest.mark.parametrize("suffix, head", [(".png", b"\x89PNG"), (".svg", b"<?xml")])
def test_the_command_writes_a_picture_and_says_what_it_shows(xml, tmp_path, capfd, suffix, head):
    out = tmp_path / f"kernel{suffix}"
    assert cli.main(["explain", str(xml), "--pixel", "1,1", "-o", str(out)]) == 0
    text, errors = capfd.readouterr()
    assert errors == "" and out.read_bytes().startswith(head)
    for part in ("pixel 1,1: kernel of aspect", "plate [RoughConductor]", "photons inside"):
        assert part in text


def test_the_command_gives_json(xml, capfd):
    assert cli.main(["explain", str(xml), "--pixel", "1,1", "--json"]) == 0
    told = json.loads(capfd.readouterr().out)
    assert told["pixel"] == [1, 1] and told["kernel"]["follows_lobe"]
    assert told["lobe"]["lam"] == pytest.approx(100, rel=1e-3)


def test_nothing_to_draw_is_no_error(xml, tmp_path, capfd):
    depth = 'type="aniso_pm"><integer name="max_depth" value="2"/>'
    xml.write_text(xml.read_text().replace('type="aniso_pm">', depth))
    out = tmp_path / "kernel.png"
    status = cli.main(["explain", str(xml), "--pixel", "1,1", "-o", str(out)])
    text, errors = capfd.readouterr()
    assert status == 0 and "needs no photon map" in text
    assert "no kernel to draw" in errors and not out.exists()


@pytest.mark.parametrize(
    "arguments, words",
    [
        (["--pixel", "4,1"], "x may be 0 to 3, y 0 to 2"),
        (["--pixel", "0,-1"], "x may be 0 to 3, y 0 to 2"),
        (["--pixel", "middle"], "two whole numbers X,Y, not 'middle'"),
        (["--pixel", "1,1", "-o", "a.pdf"], ".png or .svg"),
        (["--pixel", "1,1", "--sample", "64"], "--sample"),
        ([], "--pixel"),
    ],
)
def test_wrong_usage_is_one_line(xml, capfd, arguments, words):
    assert cli.main(["explain", str(xml), *arguments]) == 2
    errors = capfd.readouterr().err
    assert errors.count("\n") == 1 and words in errors
