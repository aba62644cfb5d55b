"""The cases of ``aniso-pm stability``, one test each, and random ones.

The list is the command's own: a row of its table and a test are the same thing.
"""

import json
import math
import os
import subprocess
import sys

import aniso_pm  # noqa: F401
import mitsuba as mi
import numpy as np
import pytest
from aniso_pm import cli
from aniso_pm.instruments.stability import all_cases, case, fuzz, page, planes, regions, soak
from aniso_pm.instruments.stability import reference as ref
from aniso_pm.instruments.stability.lanes import arr, asg, ellipse_error, lobes, off_by_sigmas, vec
from aniso_pm.kernel import RULES, kernel_axes
from hypothesis import given, settings
from hypothesis import strategies as st

mi.set_variant("llvm_ad_rgb")
CASES = all_cases()


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


@pytest.mark.parametrize(
    "one",
    [pytest.param(c, id=c.title, marks=[pytest.mark.slow] if c.slow else []) for c in CASES],
)
def test_case(one):
    (row,) = case.run([one])
    if row.verdict == case.LEFT_OUT:
        pytest.skip(row.reason)
    expected = case.PASS if one.region is None else case.FALLBACK
    assert row.verdict == expected, f"{row.reason} at {row.measured.at}"


def test_there_are_enough_cases_with_titles_of_their_own_and_known_regions():
    assert len(CASES) >= 60
    assert len({c.title for c in CASES}) == len(CASES)
    assert {c.region for c in CASES} - {None} <= {region.key for region in regions.REGIONS}


# --- Verdicts ------------------------------------------------------------------------------------


def _case(worst, fallback=0.0, region=None):
    return case.Case("g", "n", "q", 1e-3, lambda: case.Measured(worst, "", fallback), region)


@pytest.mark.parametrize(
    "worst, fallback, region, verdict",
    [
        (1e-4, 0.0, None, case.PASS),
        (1e-2, 0.0, None, case.FAIL),
        (math.nan, 0.0, None, case.FAIL),
        (math.inf, 0.0, None, case.FAIL),
        (0.0, 0.5, None, case.FAIL),  # a fallback acted that was not to act
        (0.0, 0.5, "cap", case.FALLBACK),
        (0.0, 0.0, "cap", case.FAIL),  # it was to act, and was not counted
        (1e-2, 0.5, "cap", case.FAIL),
    ],
)
def test_only_right_answers_pass_and_fallbacks_say_so(worst, fallback, region, verdict):
    (row,) = case.run([_case(worst, fallback, region)])
    assert row.verdict == verdict


def test_an_exception_is_a_row_that_fails():
    def broken():
        raise RuntimeError("no such luck")

    (row,) = case.run([case.Case("g", "n", "q", 1.0, broken)])
    assert row.verdict == case.FAIL and "no such luck" in row.reason


def test_the_worst_of_several_is_the_one_that_is_not_a_number():
    assert case.worst_of([1.0, math.nan, 5.0], "abc")[1] == "b"
    assert case.worst_of([1.0, 7.0, 5.0], "abc") == (7.0, "b")


def test_ellipse_error_sees_both_axes_and_turns():
    axes = np.array([[3.0, 0, 0], [0, 1.0, 0]])
    assert ellipse_error(axes[::-1], axes) < 1e-12  # the order of the axes is no matter
    assert ellipse_error(axes * [[1], [1.01]], axes) == pytest.approx(0.01)
    assert ellipse_error(axes * [[1.01], [1]], axes) == pytest.approx(0.01)
    c, s = math.cos(1e-3), math.sin(1e-3)
    turned = np.array([[3 * c, 3 * s, 0], [-s, c, 0]])
    # To first order (A − 1/A)/2 times the angle.
    assert ellipse_error(turned, axes) == pytest.approx((3 - 1 / 3) / 2 * 1e-3, rel=0.01)
    assert math.isnan(ellipse_error(axes * np.nan, axes))


def test_kernel_mass_sees_a_wrong_normalisation():
    s, t, n = (np.array([v]) for v in ([0.3, 0, 0], [0, 0.1, 0], [0, 0, 1.0]))
    radius = np.array([1.0])
    assert abs(planes.kernel_mass(s, t, n, radius)[0] - 1) < 1e-5
    # Sheared axes belong to `coordinates`; taken for orthogonal ones they lose mass.
    assert abs(planes.kernel_mass(s, t + 0.1 * s, n, radius)[0] - 1) > 1e-3


# --- Random lobes --------------------------------------------------------------------------------

_ALPHA = st.floats(-4, 0).map(lambda x: 10**x)
_SIGMAS = st.floats(-12, 12)


@settings(max_examples=60, deadline=None)
@given(
    _ALPHA, _ALPHA, _SIGMAS, _SIGMAS, st.floats(-8, 1), st.sampled_from(RULES), st.integers(0, 99)
)
def test_random_axes_agree_with_50_digits(alpha_u, alpha_v, x, y, log_epsilon, rule, seed):
    lobe = lobes(np.array([[1.0, 1.0], [alpha_u, alpha_v]]), seed)
    lobe = type(lobe)(**{k: v[1:] for k, v in vars(lobe).items()})
    if rule == "paper" and abs(x) + abs(y) < 1e-3:
        x = 1.0  # without a gradient the printed length is infinite
    r = off_by_sigmas(lobe, x, y)
    epsilon = 10**log_epsilon
    found = [arr(w)[0] for w in kernel_axes(asg(lobe), vec(r), epsilon, rule)]
    assert ellipse_error(found, ref.MP_AXES[rule](lobe, 0, r[0], epsilon)) < 1e-3


@settings(max_examples=20, deadline=None)
@given(
    _ALPHA,
    _ALPHA,
    st.floats(-1, 1),
    st.floats(-6, 6),
    st.floats(-4, 4),
    st.floats(0, 4),
    st.sampled_from(RULES),
    st.booleans(),
)
def test_random_kernels_have_mass_one(alpha, beta, cosine, distance, radius, cap, rule, guard):
    situation = planes.Situation(
        cosine=cosine,
        distance=10**distance,
        radius=10**radius,
        alphas=(alpha,),
        aspects=(max(1.0, beta / alpha),),
        max_aspect=10**cap,
        rule=rule,
        guard=guard,
    )
    measured = planes._mass(situation)
    assert measured.worst < 1e-3, measured.at


# --- Random scenes, many renders -----------------------------------------------------------------


def test_random_scenes_are_the_same_for_the_same_seed():
    first, second, other = (str(fuzz.random_scene(seed)) for seed in (3, 3, 4))
    assert first == second != other


@pytest.mark.fuzz
def test_random_scenes_render():
    first = int(os.environ.get("ANISO_PM_FUZZ_SEED", np.random.SeedSequence().entropy % 10**6))
    seconds = float(os.environ.get("ANISO_PM_FUZZ_SECONDS", 60))
    done, findings = fuzz.run(first, seconds)
    assert done and not findings, f"from seed {first} on: {findings}"


def test_a_crash_and_a_hang_are_findings(monkeypatch):
    script = "import sys, os, time; print('begin 7', flush=True); {}"
    for ending, words in (("os.abort()", "status -6"), ("time.sleep(60)", "no answer")):
        command = [sys.executable, "-c", script.format(ending)]
        real = subprocess.Popen
        monkeypatch.setattr(fuzz, "HANGS", 3.0)
        monkeypatch.setattr(subprocess, "Popen", lambda _, c=command, r=real, **k: r(c, **k))
        done, findings = fuzz.run(7, 1)
        assert done == 0 and findings[0].startswith("seed 7") and words in findings[0]
        monkeypatch.undo()


@pytest.mark.slow
def test_a_short_soak_changes_no_picture():
    _, worst = soak.soak(renders=4, every=1, warm_up=2)
    assert worst < 1e-3  # the order of sums
    assert mi.variant() == "llvm_ad_rgb"


# --- The command ---------------------------------------------------------------------------------


@pytest.fixture
def few_cases(monkeypatch):
    import aniso_pm.instruments.stability

    cases = [_case(1e-4), _case(0.5, 1.0, "cap"), _case(math.nan)]
    monkeypatch.setattr(aniso_pm.instruments.stability, "all_cases", lambda: cases)


def test_the_command_writes_json_page_and_markdown(few_cases, tmp_path, capsys):
    out = tmp_path / "new" / "directory"
    assert cli.main(["stability", "-o", str(out), "--json"]) == 1  # two of them fail
    assert sorted(p.name for p in out.iterdir()) == sorted(page.FILES)
    found = json.loads((out / "stability.json").read_text())
    assert found == json.loads(capsys.readouterr().out)
    assert found["schema"] == 1 and found["counts"] == {
        "pass": 1,
        "fallback": 0,
        "FAIL": 2,
        "left out": 0,
    }
    assert found["rows"][2]["worst"] is None and found["rows"][0]["worst"] == 1e-4
    html = (out / "stability.html").read_text()
    assert "http" not in html.replace("http-equiv", "") and 'name="viewport"' in html
    assert (out / "stability.md").read_text().count("| FAIL") == 2


def test_the_command_says_what_is_missing(tmp_path, capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "mpmath", None)
    assert cli.main(["stability", "-o", str(tmp_path)]) == 2
    assert "pip install 'aniso-pm[stability]'" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []


def test_the_command_refuses_a_directory_it_cannot_make(tmp_path, capsys):
    (tmp_path / "file").touch()
    assert cli.main(["stability", "-o", str(tmp_path / "file")]) == 2
    assert "file" in capsys.readouterr().err
