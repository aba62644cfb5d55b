"""What the survey finds, against what renderings of known noise show."""

import gc
from dataclasses import replace
from types import SimpleNamespace

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm.instruments import gallery
from aniso_pm.map.photon_map import photon_flux, thinned
from aniso_pm.rendering import pairs, pilot, plan, reading, survey
from aniso_pm.rendering.decisions import WORTH_FOLLOWING
from aniso_pm.rendering.prepared import prepare
from aniso_pm.rendering.settings import Settings
from aniso_pm.rendering.tiles import SAMPLES, Tiles
from aniso_pm.transport import eye
from rooms import room, room_with_ball, room_with_plate


def settled(definition, each=16, **settings):
    scene = mi.load_dict(definition)
    prepared = prepare(scene, Settings(**settings), False)
    return pilot.settle(prepared, scene.sensors()[0], 0, each), scene


def test_a_scene_without_photons_needs_none_and_no_gathers(variant_llvm_rgb):
    found, _ = settled(room(size=32))
    assert found.share == 1 and found.widths.size == 1
    assert found.count == pilot.FEWEST


def test_what_is_given_is_kept(variant_llvm_rgb):
    scene = mi.load_dict(room_with_ball(size=16))
    given = Settings(map="global", photon_count=12_345, initial_radius=0.07)
    found = pilot.settle(prepare(scene, given, False), scene.sensors()[0], 0, 16)
    assert (found.count, found.radius) == (12_345, 0.07)
    assert (found.widths == 1).all()  # no widths beside a radius that was given


def test_it_is_a_function_of_scene_and_seed(variant_llvm_rgb):
    first, second = (settled(room_with_ball(size=24), map="global")[0] for _ in range(2))
    assert first.count == second.count
    np.testing.assert_array_equal(first.share, second.share)
    np.testing.assert_allclose(first.widths, second.widths, rtol=1e-3)


def test_more_samples_ask_for_more_light_paths(variant_llvm_rgb):
    """Less than in proportion: every gather meets more of them."""
    few, many = (settled(room_with_ball(size=24), each, map="global")[0] for each in (128, 512))
    assert 1.7 * few.count < many.count < 4 * few.count


def test_lobes_are_followed_where_kernels_behind_them_matter(variant_llvm_rgb):
    """Far from metal that reflects fine light, and not in a small room with a plate."""

    found = {}

    def follows(scene, **settings):
        prepared = prepare(scene, Settings(**settings), False)
        if scene not in found:
            found[scene] = pilot.settle(prepared, scene.sensors()[0], 0, 16)
        return found[scene].applied(prepared).follow_lobes

    wall = mi.load_file(str(gallery.directory() / "brushed_wall.xml"), width="80", height="60")
    near = mi.load_dict(room_with_plate(size=24))
    assert follows(wall) and not follows(near)
    assert 0 <= found[near].lobes < 0.1 < WORTH_FOLLOWING < found[wall].lobes <= 1
    for asked in ({"kernel": "anisotropic"}, {"photon_count": 10**5}, {"initial_radius": 0.05}):
        assert follows(near, map="global", **asked), asked
    assert not follows(wall, kernel="isotropic")


def test_kernels_are_wide_where_light_is_smooth_and_narrow_at_an_edge():
    """The rule itself, with photons of equal noise everywhere and light that changes on the right
    half only."""
    tiles = Tiles(2, 64, 48)
    count = tiles.across * tiles.down
    change = np.zeros((tiles.down, tiles.across))
    change[:, 20:] = 0.04
    widths = plan.kernel_widths(tiles, np.full(count, 2e5), change.ravel(), 16 * 1e5)
    assert (widths[:, :14] == plan._WIDEST).all()
    smooth, edge = widths[:, :14].mean(), widths[:, 25:]
    assert edge.mean() < 0.6 * smooth
    # bias² = 2/3 of the variance at the minimum, bias² + half a standard error being given
    bias2 = (0.04 + tiles.uncertainty(change.ravel())[:, 28]) / (2**1.5 - 1) ** 2
    w = widths[:, 28]
    np.testing.assert_allclose(bias2 * (w / 4) ** 3, 2 / 3 * 2e5 / (16e5 * w**2), rtol=1e-6)


def test_variances_are_those_of_the_samples(variant_llvm_rgb):
    """V_r, V_g, V_gp and V_p of numbers that are made to have them."""
    random = np.random.default_rng(1)
    count, k = 200_000, SAMPLES
    gather = random.normal(0, np.sqrt(0.3 / k), (count, 2))  # of each mean, whatever the map
    shared = random.normal(0, np.sqrt(0.2), (2, count, 1))  # of each map
    alone = random.normal(0, np.sqrt(0.5 / k), (2, count, 2))
    a, b = (gather + shared[m] + alone[m] for m in (0, 1))
    weight = np.ones(count)
    assert plan.within(a, b, weight).mean() == pytest.approx(0.3, rel=0.03)
    v_shared, v_alone = plan.of_photons(a - b, weight)
    assert v_shared.mean() == pytest.approx(0.2, rel=0.03)
    assert v_alone.mean() == pytest.approx(0.5, rel=0.03)


@pytest.mark.parametrize("use", ["global", "caustic"])
def test_work_that_a_plan_counts_is_what_passes_do(variant_llvm_rgb, monkeypatch, use):
    scene = mi.load_dict(room_with_ball(size=64))
    plans, of = [], plan.Plan._of

    def watched(each, **given):
        plans.append((of(each, **given), given))
        return plans[-1][0]

    monkeypatch.setattr(plan.Plan, "_of", staticmethod(watched))
    plugin = mi.load_dict({"type": "aniso_pm", "map": use, "kernel": "isotropic", "passes": 1})
    mi.render(scene, integrator=plugin, spp=64)
    found, given = plans[-1]
    s = plugin.statistics
    counted = 64 * found.tiles.pixels * float((found.path_work - given["whole"]).mean())
    gathers = plan._GATHER * s["gather_points"] + plan._MET * s["photons_gathered"]
    assert counted == pytest.approx(gathers, rel=0.25)
    light = plan.LIGHT_PATH * s["photons_emitted"] + plan.LEFT * s["photons_stored"]
    assert found.light_work == pytest.approx(light, rel=0.1)


def _plan(light_paths=0, met=4000.0, aside=5.0, edge=2, alpha=1.0, **more):
    """Of a picture whose left third has nearly all photons: so many that an eye path meets there,
    and ``aside``; light beside it is smooth. edge: of tiles, in pixels."""
    random = np.random.default_rng(2)
    tiles = Tiles(edge, 48 * edge, 24 * edge)
    left = np.zeros((tiles.down, tiles.across), bool)
    left[:, :16] = True
    left = left.ravel()

    def noise(variance):
        return random.normal(0, np.sqrt(np.where(left, variance, 1e-3 * variance)))[..., None]

    pairs = np.ones(left.size)
    gather = [0.1 * random.normal(size=(left.size, 2)) for _ in range(2)]
    a, b = (1 + g + noise(0.1 * pairs) + 0.1 * random.normal(size=g.shape) for g in gather)
    change = np.where(left, 0.3, 0)[:, None]  # from narrow kernels to wide ones
    found = plan.Found(
        a=a,
        b=b,
        wide_a=a + change,
        wide_b=b + change,
        over_lobes=0 * a,
        met=np.where(left, met, aside),
        points=pairs,
        emitted=50_000,
        stored=100_000,
        aim=None,
        met_by_any=10_000,
    )
    return plan.Plan._of(
        32,
        tiles=tiles,
        choose=True,
        light_paths=light_paths,
        filtered=1.0,
        whole=2 * pairs,
        alpha=alpha,
        **{"use": "global", "weight": pairs, "v_own": 0.2 * pairs, "found": found, "total": 1e6}
        | more,
    )


@pytest.mark.parametrize("edge", [1, 2, 8])
def test_no_other_number_of_light_paths_promises_less(edge):
    best = _plan(edge=edge)
    assert best.light_paths > 1000
    for factor in (0.25, 0.5, 2, 4):
        other = _plan(light_paths=factor * best.light_paths, edge=edge)
        assert best.error < 1.1 * other.error, factor


def test_kernels_that_shrink_promise_more_noise_and_less_bias():
    """α = 1: they stay. Else photons' noise goes by the mean of (r_0/r_i)², here from the product
    that defines r_i, and bias by that of (r_i/r_0)^1.5."""
    alpha = 0.5
    i = np.arange(1, plan.PASSES)
    area = np.concatenate([[1], np.cumprod((i + alpha) / (i + 1))])
    stays, shrinks = (_plan(light_paths=2000, alpha=a) for a in (1.0, alpha))
    assert 1 < shrinks.error / stays.error < (1 / area).mean()
    # With next to no photons nearly all of the error is their noise.
    few = [_plan(light_paths=2, alpha=a).error for a in (1.0, alpha)]
    assert few[1] / few[0] == pytest.approx((1 / area).mean(), rel=0.05)
    # After endless work all of it is bias².
    bias2 = [_plan(light_paths=2000, alpha=a, total=1e30).error for a in (1.0, alpha)]
    assert bias2[1] / bias2[0] == pytest.approx((area**0.75).mean() ** 2)


def test_passes_without_a_map_cost_next_to_nothing_besides():
    none = _plan(use="none", found=None, edge=1)
    per_sample = none.work / (32 * none.tiles.pixels)
    assert per_sample == pytest.approx(2 + plan._PASS_WITHOUT / (32 * none.tiles.pixels))
    assert plan._PASS_WITHOUT < 0.2 * plan._PASS


@pytest.mark.parametrize(
    ("caustic", "alone", "use"),
    [(0.6, 0.9, "caustic"), (0.3, 0.9, "global"), (0.3, 2, "none"), (0.6, 5, "none")],
)
def test_a_use_is_chosen_if_it_is_better_by_enough(
    variant_llvm_rgb, monkeypatch, caustic, alone, use
):
    """Here the caustic map promises 0.44 of the global one's error, path tracing 1.5 times that."""
    monkeypatch.setattr(survey, "_BETTER", caustic)
    monkeypatch.setattr(survey, "_BETTER_ALONE", alone)
    found, _ = settled(room_with_ball(size=24))
    assert found.use == use
    best = found.errors["caustic" if caustic == 0.6 else "global"]
    assert (found.errors["none"] < alone * best) == (use == "none")
    assert (found.errors["caustic"] < caustic * found.errors["global"]) == (caustic == 0.6)


def test_pairs_of_a_closed_room_are_traced_once(variant_llvm_rgb, monkeypatch):
    """Their paths leave more than three gather points each."""
    traced = []

    def eye_paths(*wavefront, trace=eye.eye_paths, **watch):
        traced.append(wavefront)
        return trace(*wavefront, **watch)

    monkeypatch.setattr(eye, "eye_paths", eye_paths)
    world = mi.load_dict(room_with_ball(size=24))
    scene = replace(prepare(world, Settings(), False), chosen="survey")
    seen = pairs.look(scene, world.sensors()[0], 0)
    assert dr.width(seen.points.lane) > 3 * seen.tiles.lanes
    assert len(traced) == 1


def test_what_every_pass_costs_is_worth_light_paths_in_small_pictures(monkeypatch):
    with_it = [_plan(edge=edge).light_paths for edge in (3, 16)]
    monkeypatch.setattr(plan, "_PASS", 0.0)
    without = [_plan(edge=edge).light_paths for edge in (3, 16)]
    small, large = (a / b for a, b in zip(with_it, without, strict=True))
    assert small > 1.08 and large == pytest.approx(1, abs=0.02)


def test_photons_that_gathers_meet_are_counted_where_they_are():
    """Kernels are wide on the right, where there are next to none."""
    widths = _plan().widths.reshape(24, 48)
    narrow, wide = widths[:, :8], widths[:, 30:]
    assert wide.min() > 4 * narrow.max()
    given = {"light_paths": 50_000}
    here, nowhere, more = (_plan(**given, met=met).work for met in (4000, 0, 8000))
    aside = _plan(**given, met=0, aside=4000).work
    assert 0 < here - nowhere < 0.1 * (aside - nowhere)
    assert here < more


def test_work_is_counted_once_where_gather_points_need_more_room(variant_llvm_rgb, monkeypatch):
    world = mi.load_dict(room_with_ball(size=16))
    scene = replace(prepare(world, Settings(), False), chosen="survey")
    sensor = world.sensors()[0]
    works = []
    for many in (100_000, 100):  # enough at once; too little at first
        monkeypatch.setattr(eye, "_room_at_first", lambda *_, many=many: many)
        seen = pairs.look(scene, sensor, 0)
        assert dr.width(seen.points.lane) > 100
        works.append(seen.work)
    np.testing.assert_array_equal(*works)


@pytest.mark.parametrize(
    "lambertian, times",
    [(None, 1), ([], 1), ([True] * 4, 1), ([False] * 4, 3), ([True, False] * 2, 2)],
)
def test_gathers_that_ask_a_bsdf_are_dearer(variant_llvm_rgb, lambertian, times):
    points = SimpleNamespace(lambertian=None if lambertian is None else mi.Bool(lambertian))
    assert reading.dearer(points, 3.0) == pytest.approx(times)


def test_a_map_thinned_holds_some_of_the_light_paths(variant_llvm_rgb):
    world = mi.load_dict(room_with_ball(size=16))
    scene = prepare(world, Settings(photon_count=4000, map="global"), False)
    whole = scene.photon_map(5, 0, remember=True)
    part = thinned(whole, 1000)
    path = whole.origins.path.numpy()
    kept = path < 1000
    assert part.emitted == 1000 and part.stored == kept.sum() < whole.stored
    np.testing.assert_array_equal(np.sort(part.origins.path.numpy()), np.sort(path[kept]))
    np.testing.assert_array_equal(part.origins.numbers, whole.origins.numbers[:1000])
    slots = [dr.arange(mi.UInt32, map_.stored) for map_ in (whole, part)]
    flux = [photon_flux(*each, True).numpy() for each in zip((whole, part), slots, strict=True)]
    assert flux[1].sum() == pytest.approx(flux[0][:, kept].sum(), rel=1e-5)
    assert thinned(whole, 4000) is whole
    assert thinned(replace(whole, sums="of another index"), 1000).sums is None


def test_a_pilot_looks_at_photons_one_by_one(variant_llvm_rgb):
    """It reads parts of its maps, which no sums are of, and asks what each photon gives."""
    exact, summed = (
        settled(room_with_ball(size=64), map="global", gather_tolerance=t)[0] for t in (0.0, 0.2)
    )
    assert summed.count == exact.count
    np.testing.assert_array_equal(summed.widths, exact.widths)


def test_a_pilot_gathers_no_more_where_photons_lie_close(variant_llvm_rgb, monkeypatch):
    """In a room with the light inside, kernels of eight pixels of a small picture hold hundreds."""
    met = []
    gathered = reading.Reader._gathered

    def watched(reader, *given):
        found = gathered(reader, *given)
        met.append(found[2].mean() * reader.lanes)
        return found

    monkeypatch.setattr(reading.Reader, "_gathered", watched)
    found, _ = settled(room_with_ball(size=128), map="global")
    few, *all_ = met
    assert reading._ASKED * few > 4 * reading._MET_BY_ALL  # or there is nothing to leave out
    assert len(all_) == 4 and max(all_) < 1.5 * reading._MET_BY_ALL
    monkeypatch.setattr(reading, "_MET_BY_ALL", 1e9)
    more, _ = settled(room_with_ball(size=128), map="global")
    # They tell the same, but for widths: where they are less certain kernels are narrower, meet
    # fewer photons, and are worth more of them.
    assert more.count < found.count < 2 * more.count
    assert found.share.mean() == pytest.approx(more.share.mean(), abs=0.1)
    assert 0.6 * more.widths.mean() < found.widths.mean() < 1.1 * more.widths.mean()


@pytest.mark.parametrize(
    ("light", "eye", "each"),
    [
        (0, 1e4, 27),  # short
        (0, 2e5, 7),  # long by its eye paths: within the limit
        (1e5, 1e6, 4),  # no fewer than four samples, up to four times as long
        (1e5, 3e6, 1),
        (1.3e6, 1e4, 1),  # long by its light paths: no such allowance
    ],
)
def test_passes_of_open_end_are_short(monkeypatch, light, eye, each):
    """light, eye: work of a pass with one sample a pixel."""

    def of(each, **_):
        return SimpleNamespace(each=each, light_work=light * each, work=(light + eye) * each)

    monkeypatch.setattr(plan.Plan, "_of", staticmethod(of))
    assert plan.Plan.of(1.5e6, 27, light_paths=0).each == each


@pytest.mark.parametrize(
    ("light", "eye", "each"), [(1e7, 1e4, 27), (1e7, 1e6, 14), (1e5, 2e5, 7), (1e5, 3e6, 1)]
)
def test_light_paths_that_somebody_wants_take_no_samples_away(monkeypatch, light, eye, each):
    """light: work of a pass's light paths, however many samples; eye: of each sample a pixel."""

    def of(each, **_):
        return SimpleNamespace(each=each, light_work=light, work=light + eye * each)

    monkeypatch.setattr(plan.Plan, "_of", staticmethod(of))
    assert plan.Plan.of(1.5e6, 27, light_paths=100_000).each == each


@pytest.mark.parametrize(
    ("light", "eye", "given", "paths"),
    [
        (1e6, 1e4, 0, 1e6),
        (4e6, 1e4, 0, 1.5e6),  # as long as a pass may be
        (9e6, 3e6, 0, 3e6),  # as long as the eye paths beside them
        (4e6, 1e4, 4e6, 4e6),  # somebody wants them
    ],
)
def test_light_paths_of_one_sample_a_pixel_make_no_long_pass(monkeypatch, light, eye, given, paths):
    """light, eye: work of a pass, whatever its samples; each light path's is one."""

    def of(each, *, light_paths):
        paths = light_paths or light
        return SimpleNamespace(each=each, light_paths=paths, light_work=paths, work=paths + eye)

    monkeypatch.setattr(plan.Plan, "_of", staticmethod(of))
    assert plan.Plan.of(1.5e6, 1, light_paths=given).light_paths == pytest.approx(paths)


def test_path_tracing_has_found_caustics_by_hits_or_where_there_are_next_to_none():
    weight, there = np.ones(1000), np.full((1000, 2), 0.1)
    many, few = np.zeros((1000, 2)), np.zeros((1000, 2))
    many[:200, 0], few[:20, 0] = 1.0, 10.0  # the light of the map, by 200 hits and by 20
    assert survey._doubt(many, [there], weight) == 1
    assert survey._doubt(few, [there], weight) == pytest.approx(64 / 20)
    fewest = np.zeros((1000, 2))
    fewest[:7, 0] = 200 / 7
    assert survey._doubt(fewest, [there], weight) is None
    assert survey._doubt(0.5 * many, [there], weight) is None
    assert survey._doubt(0 * many, [5e-4 * there], weight) == 1
    assert survey._doubt(0 * many, [5e-3 * there], weight) is None


def test_few_hits_of_caustics_count_against_path_tracing(variant_llvm_rgb, monkeypatch):
    promised = []
    for doubt in (1.0, 100.0, None):
        monkeypatch.setattr(survey, "_doubt", lambda *_, doubt=doubt: doubt)
        promised.append(settled(room_with_plate(size=24), map="auto")[0].errors["none"])
    assert promised[1] > 1.5 * promised[0] > 0 and promised[2] is None


@pytest.mark.parametrize("make", [room, room_with_ball])
def test_gathers_of_a_pilot_are_recorded_once(variant_llvm_rgb, make):
    """Whatever the width of kernels, map and points, whether photons are scored, and whether every
    eye path ends at a gather point, as in a room with nothing but diffuse walls."""
    gc.collect()  # scenes of other tests: Dr.Jit tells sizes of their arrays apart as well
    scene = mi.load_dict(make(size=24))
    prepared = prepare(scene, Settings(map="global"), False).frozen()
    pilot.settle(prepared, scene.sensors()[0], 0, 16)
    assert prepared.launch.gather.n_recordings == 1


def test_uses_are_compared_by_a_part_of_the_pairs(variant_llvm_rgb, monkeypatch):
    """All of them read a map only for the use that is chosen: the plan is what it would be."""
    readers = []
    found = reading.Reader.found

    def watched(reader, *given):
        readers.append(reader.pairs.size)
        return found(reader, *given)

    monkeypatch.setattr(reading.Reader, "found", watched)
    monkeypatch.setattr(survey, "_CLOSE", 0)
    by_few, _ = settled(room_with_ball(size=64))
    assert readers == [1024, 1024] + [4096] * (by_few.use != "none")
    monkeypatch.setattr(reading.Reader, "of_every_fourth", lambda *_: None)
    by_all, _ = settled(room_with_ball(size=64))
    assert by_few.use == by_all.use and by_few.count == by_all.count
    np.testing.assert_array_equal(by_few.share, by_all.share)
    np.testing.assert_allclose(by_few.widths, by_all.widths, rtol=1e-4)

    def against_global(errors):
        return errors["caustic"] / errors["global"]

    assert against_global(by_few.errors) == pytest.approx(against_global(by_all.errors), rel=0.15)
