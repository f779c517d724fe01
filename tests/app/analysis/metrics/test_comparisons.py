"""The statistics of one metric by controller."""

from __future__ import annotations

from itertools import combinations

import pytest

from app.analysis.metrics import ALPHA, Group, compare, group, sessions_needed, smallest_p
from app.tables.sessions import Controller
from ml.statistics.ranksum import rank_sum


def _group(controller: Controller, values: list[float]) -> Group:
    return group(controller, dict(enumerate(values)))


def test_a_group_has_its_quartiles() -> None:
    g = _group(Controller.RL, [1.0, 2.0, 3.0, 4.0, 5.0])
    assert (g.n, g.q1, g.median, g.q3) == (5, 2.0, 3.0, 4.0)
    nobody = _group(Controller.RL, [])
    assert (nobody.n, nobody.median) == (0, None)


def test_full_separation_of_four_and_four_gives_the_p_of_counting() -> None:
    # 2 of the C(8, 4) = 70 equally likely rankings are this extreme
    result = compare(_group(Controller.RL, [0.1, 0.2, 0.3, 0.4]), _group(Controller.CDBS, [1.0, 1.1, 1.2, 1.3]))
    assert result.p_value == pytest.approx(2 / 70)
    assert (result.method, result.n_controller, result.n_cdbs, result.note) == ("exact", 4, 4, "")
    assert result.difference == pytest.approx(-0.9)
    assert result.low is not None
    assert result.high is not None
    assert result.low <= -0.9 <= result.high < 0


def test_tied_values_are_tested_exactly_given_the_ties() -> None:
    result = compare(_group(Controller.RL, [7, 7, 8, 9, 9]), _group(Controller.CDBS, [7, 8, 8, 9, 10]))
    assert result.method == "exact"
    assert result.p_value is not None
    assert result.p_value > ALPHA


def test_ties_do_not_give_a_smaller_p_than_so_few_sessions_can() -> None:
    # cDBS always runs at 1, so that its energies tie; a normal curve would say .0005
    three, eleven = [0.0, 0.0, 0.0], [1.0] * 11
    result = compare(_group(Controller.NO_DBS, three), _group(Controller.CDBS, eleven))
    assert result.p_value == pytest.approx(2 / 364)  # C(14, 3)


@pytest.mark.parametrize(
    ("tested", "cdbs", "words"),
    [
        (
            2,
            5,
            "needs at least 4 sessions on each side, or 3 against 5; No DBS has 2, cDBS 5. So few cannot give a two-sided p below .095",
        ),
        (3, 4, "needs at least 4 sessions on each side; No DBS has 3, cDBS 4. So few cannot give a two-sided p below .057"),
        (6, 2, "or 8 against 2; No DBS has 6, cDBS 2"),
        (0, 9, "needs at least 4 sessions with this metric on each side; No DBS has 0, cDBS 9"),
        (9, 0, "No DBS has 9, cDBS 0"),
    ],
)
def test_not_enough_data_names_the_check_that_failed(tested: int, cdbs: int, words: str) -> None:
    result = compare(
        _group(Controller.NO_DBS, [0.1 * i for i in range(tested)]), _group(Controller.CDBS, [5 + 0.1 * i for i in range(cdbs)])
    )
    assert result.p_value is None
    assert result.difference is None
    assert words in result.note


@pytest.mark.parametrize("n_other", range(2, 12))
def test_the_number_of_sessions_asked_for_is_the_smallest_that_reaches_05(n_other: int) -> None:
    needed = sessions_needed(n_other)
    assert needed is not None
    others = [100.0 + i for i in range(n_other)]
    assert rank_sum([float(i) for i in range(needed)], others).p_value < ALPHA
    assert rank_sum([float(i) for i in range(needed - 1)], others).p_value >= ALPHA if needed > 1 else True


def test_the_smallest_p_is_that_of_counting_every_ranking() -> None:
    rankings = list(combinations(range(7), 3))
    extreme = [r for r in rankings if r in {(0, 1, 2), (4, 5, 6)}]
    assert smallest_p(3, 4) == pytest.approx(len(extreme) / len(rankings))
