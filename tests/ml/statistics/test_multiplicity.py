from __future__ import annotations

from itertools import combinations

import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.stats import false_discovery_control

from ml.statistics.multiplicity import benjamini_hochberg, holm, hommel


def test_holm_agrees_with_a_worked_example():
    # sorted .005 .01 .03 .04 times 4 3 2 1 is .02 .03 .06 .04, and may not fall: .02 .03 .06 .06
    assert holm([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.03, 0.06, 0.06, 0.02])
    assert holm([]) == []


@given(st.lists(st.floats(0, 1), min_size=1, max_size=12))
def test_holm_agrees_with_its_definition(p_values):
    m = len(p_values)
    ranked = sorted(range(m), key=lambda i: p_values[i])
    expected = {}
    for place, i in enumerate(ranked):
        expected[i] = max(min(1.0, (m - k) * p_values[ranked[k]]) for k in range(place + 1))
    assert holm(p_values) == pytest.approx([expected[i] for i in range(m)])


def test_hommel_agrees_with_a_worked_example():
    # all three: 3 x .02, 3 x .03 / 2 and .2, of which .045 is the least; .02 with .03: .03; .02 with .2: .04. Holm: .06, .06, .2
    assert hommel([0.02, 0.03, 0.2]) == pytest.approx([0.045, 0.06, 0.2])
    assert hommel([]) == []


@given(st.lists(st.floats(0, 1), min_size=1, max_size=5))
def test_hommel_is_closed_testing_with_simes_and_never_above_holm(p_values):
    def simes(of):
        return min(len(of) * p / k for k, p in enumerate(sorted(of), 1))

    number = range(len(p_values))
    closed = [
        max(simes([p_values[j] for j in chosen]) for size in number for chosen in combinations(number, size + 1) if i in chosen)
        for i in number
    ]
    assert hommel(p_values) == pytest.approx(closed)
    assert all(a <= b + 1e-12 for a, b in zip(hommel(p_values), holm(p_values), strict=True))


def test_benjamini_hochberg_agrees_with_a_worked_example():
    # sorted .005 .01 .03 .04 times 4/1 4/2 4/3 4/4 is .02 .02 .04 .04
    assert benjamini_hochberg([0.01, 0.04, 0.03, 0.005]) == pytest.approx([0.02, 0.04, 0.04, 0.02])
    assert benjamini_hochberg([]) == []


@given(st.lists(st.floats(0, 1), min_size=1, max_size=12))
def test_benjamini_hochberg_is_that_of_scipy_and_never_above_holm(p_values):
    found = benjamini_hochberg(p_values)
    assert found == pytest.approx(false_discovery_control(p_values).tolist())
    assert all(b <= h + 1e-12 for b, h in zip(found, holm(p_values), strict=True))
