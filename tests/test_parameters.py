"""The parameters: refused by name, round trips, XML, traverse."""

import aniso_pm  # noqa: F401
import mitsuba as mi
import numpy as np
import pytest
from renders import integrator
from rooms import room, room_with_plate

pytestmark = pytest.mark.usefixtures("without_pilot")


@pytest.mark.parametrize(
    "name, value, word",
    [
        ("kernel", "round", "anisotropic, isotropic"),
        ("rule", "best", "taylor, paper, lobe"),
        ("size", "huge", "bandwidth, epsilon"),
        ("epsilon", 0.0, "between"),
        ("epsilon", float("nan"), "between"),
        ("max_aspect", 0.5, "between"),
        ("gather_tolerance", 1.5, "between 0 and 1"),
        ("photon_count", -5, "between"),
        ("photon_count", 1.5, "integer"),
        ("photon_count", "many", "integer"),
        ("passes", -1, "between"),
        ("alpha", 0.0, "above 0"),
        ("alpha", 1.5, "at most 1"),
        ("initial_radius", -1.0, "positive"),
        ("initial_radius", float("inf"), "positive"),
        ("max_depth", 0, "unlimited"),
        ("max_depth", -2, "unlimited"),
        ("rr_depth", 0, "between"),
        ("map", "local", "global, caustic, auto"),
        ("max_memory", -1.0, "0 (automatic)"),
        ("max_memory", float("nan"), "0 (automatic)"),
        ("max_memory", "8G", "float"),
        ("guard", 1, "boolean"),
        ("guard", "true", "boolean"),
    ],
)
def test_wrong_parameters_are_refused_by_name_value_and_range(rgb, name, value, word):
    with pytest.raises(Exception) as caught:
        mi.load_dict({"type": "aniso_pm", name: value})
    text = str(caught.value)
    assert "aniso_pm" in text and f'"{name}"' in text and word in text


def test_unknown_parameters_are_reported(rgb):
    with pytest.raises(Exception, match="photons_count"):
        mi.load_dict({"type": "aniso_pm", "photons_count": 5})


def test_parameters_round_trip(rgb):
    plugin = integrator(rule="taylor", passes=7, hide_emitters=True)
    values = plugin.parameters()
    assert (values["rule"], values["passes"], values["hide_emitters"]) == ("taylor", 7, True)
    again = mi.load_dict({"type": "aniso_pm"} | values)
    assert again.parameters() == values


def test_integers_serve_as_floats(rgb):
    assert integrator(initial_radius=1).parameters()["initial_radius"] == 1.0


def test_it_loads_from_xml(rgb):
    scene = mi.load_string(
        """<scene version="3.0.0">
             <integrator type="aniso_pm">
               <string name="kernel" value="isotropic"/>
               <integer name="photon_count" value="1234"/>
               <float name="initial_radius" value="0.5"/>
             </integrator>
             <shape type="sphere"><bsdf type="asgconductor">
               <string name="material" value="Al"/>
               <float name="alpha_u" value="0.1"/><float name="alpha_v" value="0.3"/>
             </bsdf></shape>
           </scene>"""
    )
    values = scene.integrator().parameters()
    assert values["photon_count"] == 1234 and values["kernel"] == "isotropic"


def test_parameters_are_reachable_through_traverse(rgb):
    own = {"type": "aniso_pm", "photon_count": 100, "map": "global"}
    scene = mi.load_dict(room(size=4) | {"integrator": own})
    parameters = mi.traverse(scene)
    parameters["integrator.photon_count"] = 200
    parameters["integrator.guard"] = False
    parameters.update()
    settings = scene.integrator().settings
    assert (settings.photon_count, settings.guard) == (200, False)
    assert settings.alpha == 2 / 3  # untouched, not rounded
    mi.render(scene, spp=1)
    assert scene.integrator().statistics["photons_emitted"] == 200
    with pytest.raises(Exception, match='"photon_count" is -5'):
        parameters["integrator.photon_count"] = -5
        parameters.update()


def test_what_traverse_changed_is_in_the_next_picture(rgb):
    """A lamp twice as bright, walls twice as dark, a mirror that turns matt: no map, need or
    kernel outlives what it was made from."""
    definition = room_with_plate(size=8)
    scene = mi.load_dict(definition)
    plugin = integrator(photon_count=50_000)
    render = lambda s: np.array(plugin.render(s, seed=3, spp=256)).mean()  # noqa: E731
    before = render(scene)
    parameters = mi.traverse(scene)
    parameters["light.emitter.radiance.value"] *= 2
    parameters.update()
    assert render(scene) == pytest.approx(2 * before, rel=1e-3)
    parameters["plate.bsdf.brdf_0.alpha_u.value"] = 0.4
    parameters["plate.bsdf.brdf_0.alpha_v.value"] = 0.4
    parameters.update()
    definition["light"]["emitter"]["radiance"]["value"] = [16, 15, 14]
    definition["plate"]["bsdf"]["bsdf"] |= {"alpha_u": 0.4, "alpha_v": 0.4}
    fresh = render(mi.load_dict(definition))
    assert render(scene) == pytest.approx(fresh, rel=1e-3)
    assert fresh != pytest.approx(2 * before, rel=1e-3)
