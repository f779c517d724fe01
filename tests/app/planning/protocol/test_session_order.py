"""Balanced orders."""

from __future__ import annotations

from collections import Counter
from itertools import pairwise, permutations

import pytest

from app.planning.protocol.schedule import Order, latin_square, rounds, williams


@pytest.mark.parametrize("n", [1, 2, 3, 4, 5, 6])
def test_every_treatment_stands_equally_often_at_every_place(n: int) -> None:
    for rows in (latin_square(n), williams(n)):
        assert all(sorted(row) == list(range(n)) for row in rows)
        places = Counter((place, number) for row in rows for place, number in enumerate(row))
        assert set(places.values()) == {len(rows) // n}


@pytest.mark.parametrize("n", [2, 3, 4, 5, 6])
def test_in_williams_design_every_treatment_follows_every_other_equally_often(n: int) -> None:
    follows = Counter(pair for row in williams(n) for pair in pairwise(row))
    assert set(follows) == set(permutations(range(n), 2))
    assert set(follows.values()) == {2 if n % 2 else 1}


@pytest.mark.parametrize(("order", "repeats"), [(Order.LATIN_SQUARE, 1), (Order.WILLIAMS, 1), (Order.WILLIAMS, 2)])
def test_the_square_goes_on_from_visit_to_visit(order: Order, repeats: int) -> None:
    visits = 4 // repeats
    found = [tuple(r) for block in range(visits) for r in rounds(4, repeats, order, 7, block)]
    assert len(set(found)) == 4
    assert set(Counter((place, number) for row in found for place, number in enumerate(row)).values()) == {1}
    assert [tuple(r) for r in rounds(4, repeats, order, 7, visits)] == found[:repeats]


def test_the_seed_says_which_policy_is_which() -> None:
    assert len({tuple(rounds(3, 1, Order.WILLIAMS, seed, 0)[0]) for seed in range(100)}) == 6
    assert [tuple(r) for r in rounds(3, 2, Order.STATED, 1, 5)] == [(0, 1, 2)] * 2
