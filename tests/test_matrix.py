"""Indirect light of every scene of the matrix against a converged reference (tests/matrix.py)."""

import json

import matrix
import pytest

KNOWN = json.loads(matrix.REFERENCE.read_text())
# One row of each kind for every run of the tests, each with one use of the map.
QUICK = {
    "directionalarea, diffuse": "caustic",
    "brushed principled": "global",
    "two brushed plates": "final gather",
}


@pytest.fixture(autouse=True)
def _variant(variant_llvm_rgb):
    pass


def assert_agrees(name, use, tolerance, **settings):
    row = matrix.rows()[name]
    ratio, error = matrix.compare(row, use, KNOWN[name], **settings)
    print(f"{name}, {use}: {ratio:.4f} ± {error:.4f}")
    assert error < 0.3 * tolerance
    assert abs(ratio - 1) < tolerance


@pytest.mark.parametrize("name", QUICK)
def test_energy_agrees_within_three_percent(name):
    assert_agrees(name, QUICK[name], 0.03, seeds=range(3), passes=2, share=32)


@pytest.mark.slow
@pytest.mark.parametrize("use", matrix.USES)
@pytest.mark.parametrize("name", KNOWN)
def test_energy_agrees_within_one_percent(name, use):
    assert_agrees(name, use, 0.01)
