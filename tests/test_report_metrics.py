"""The report's numbers against closed forms: pictures with noise and bias that are known."""

import math

import numpy as np
import pytest
from aniso_pm.instruments.report import metrics, sweep

SHAPE = (24, 32, 3)
MASK = np.ones(SHAPE[:2], bool)


def experiment(rng, bias, noise, reference_noise, seeds=5):
    """(pictures, halves of the reference, truth)."""
    truth = rng.uniform(0.1, 1, SHAPE)
    halves = [truth + rng.normal(0, reference_noise, SHAPE) for _ in range(2)]
    return truth + bias + rng.normal(0, noise, (seeds, *SHAPE)), halves, truth


@pytest.mark.parametrize("bias", [0.0, 0.05])
def test_means_are_those_of_bias_and_noise_without_the_references_noise(bias):
    rng = np.random.default_rng(1)
    found = []
    for _ in range(60):
        pictures, halves, _ = experiment(rng, bias, 0.1, 0.1)
        table = metrics.products(pictures, halves, MASK)
        found.append((metrics.mse(table), metrics.bias2(table), metrics.variance(table)))
    mean, error = np.mean(found, 0), np.std(found, 0) / 60**0.5
    # Four standard errors; a reference whose noise of 0.1 were counted would be off by 0.005.
    assert np.all(np.abs(mean - [bias**2 + 0.01, bias**2, 0.01]) < 4 * error)
    assert np.all(error < 2e-4)


@pytest.mark.parametrize("bias", [0.0, 0.03])
def test_intervals_cover_the_truth_as_often_as_they_say(bias):
    rng = np.random.default_rng(2)
    trials, covered = 200, np.zeros(4)
    for _ in range(trials):
        pictures, halves, truth = experiment(rng, bias, 0.1, 0.005)
        table = metrics.products(pictures, halves, MASK)
        wanted = (
            (metrics.estimate(metrics.mse, table), bias**2 + 0.01),
            (metrics.estimate(metrics.bias2, table), bias**2),
            (metrics.estimate(metrics.variance, table), 0.01),
            (metrics.energy(pictures, halves, MASK), 1 + bias / truth.mean()),
        )
        covered += [e.low <= value <= e.high for e, value in wanted]
    # 95 % of 200: 190 ± 3. Bias² near 0 is covered more often: its jackknife is conservative.
    assert np.all(covered >= 0.9 * trials), covered
    assert covered[0] <= 0.99 * trials


def test_ratio_is_paired_and_covers_the_true_ratio():
    """Two methods that share most of their noise: the interval of the paired ratio is far narrower
    than those of the errors themselves."""
    rng = np.random.default_rng(3)
    covered, width = 0, []
    for _ in range(200):
        truth = rng.uniform(0.1, 1, SHAPE)
        halves = [truth, truth]
        # The strength of the noise differs from seed to seed: both methods have a bad day.
        shared = rng.normal(0, 1, (5, *SHAPE)) * rng.uniform(0.05, 0.15, (5, 1, 1, 1))
        a = metrics.products(truth + 0.9 * shared, halves, MASK)
        b = metrics.products(truth + shared, halves, MASK)
        e = metrics.ratio(a, b)
        covered += e.low - 1e-9 <= 0.81 <= e.high + 1e-9
        width.append(e.high - e.low)
    assert covered == 200 and max(width) < 1e-6
    assert metrics.verdict(e) == "better" and metrics.verdict(metrics.ratio(b, a)) == "worse"


def test_equal_methods_cannot_be_told_apart():
    rng = np.random.default_rng(4)
    told = 0
    for _ in range(200):
        a, halves, truth = experiment(rng, 0, 0.1, 0.0)
        b = truth + rng.normal(0, 0.1, a.shape)
        tables = [metrics.products(i, halves, MASK) for i in (a, b)]
        told += metrics.verdict(metrics.ratio(*tables)) != "cannot be told apart"
    assert told <= 22  # 5 % of 200 are 10 ± 3


def test_relative_errors_weigh_by_the_light_around_a_pixel():
    level = np.full(SHAPE, 0.5)
    weight = metrics.weights([level, level])
    assert weight == pytest.approx(1 / 0.26)
    table = metrics.products(np.stack([level + 0.1] * 3), [level, level], MASK, weight)
    assert metrics.mse(table) == pytest.approx(0.01 / 0.26)


def test_regions_are_kept_apart():
    level = np.full(SHAPE, 0.5)
    pictures = np.stack([level] * 3)
    left = MASK.copy()
    left[:, 16:] = False
    pictures[:, :, 16:] += 1
    assert metrics.mse(metrics.products(pictures, [level, level], left)) == 0
    assert metrics.mse(metrics.products(pictures, [level, level], ~left)) == pytest.approx(1)
    assert metrics.energy(pictures, [level, level], ~left).value == pytest.approx(3)


def test_reference_knows_its_own_error():
    rng = np.random.default_rng(5)
    halves = [0.5 + rng.normal(0, 0.1, SHAPE) for _ in range(2)]
    actual = np.mean((np.mean(halves, 0) - 0.5) ** 2)
    # Mean of two of variance 0.01: 0.005; 2304 values know it within 3 %.
    assert metrics.reference_error(halves, MASK) == pytest.approx(actual, rel=0.15)
    assert actual == pytest.approx(0.005, rel=0.15)


def test_two_runs_have_no_interval_and_that_is_said():
    level = np.full(SHAPE, 0.5)
    table = metrics.products(np.stack([level + 0.1] * 2), [level, level], MASK)
    found = metrics.estimate(metrics.mse, table)
    assert found.value == pytest.approx(0.01) and math.isnan(found.low)
    assert math.isnan(found.high)


# --- The search for a bandwidth ---


@pytest.mark.parametrize("best", [1 / 16, 0.2, 0.7, 1.0, 1.9, 3.9])
def test_sweep_finds_the_valley(best):
    factor, errors = sweep.best(lambda f: math.log(f / best) ** 2)
    assert abs(math.log(factor / best)) <= math.log(2) / 4 + 1e-9
    assert list(errors) == sorted(errors) and len(errors) <= 9


def test_sweep_ends_where_it_may_not_go_on_and_survives_failures():
    factor, errors = sweep.best(lambda f: f)
    assert factor >= sweep.RANGE[0] / 2**0.5 and len(errors) < 12
    factor, errors = sweep.best(lambda f: math.nan if f < 1 else f, fine=False)
    assert factor == 1 and errors[0.5] == math.inf
