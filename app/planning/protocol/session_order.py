"""Balanced orders of the policies of a visit, pure. Source: Williams 1949, "Experimental designs balanced for the estimation of residual
effects of treatments"."""

from __future__ import annotations

from collections.abc import Sequence
from enum import StrEnum

import numpy as np


class Order(StrEnum):
    """How the order of a visit's policies is found."""

    DRAWN = "drawn"  # from the seed
    LATIN_SQUARE = "latin_square"  # every policy at every place equally often
    WILLIAMS = "williams"  # and after every other equally often
    STATED = "stated"  # as they were named


def latin_square(treatments: int) -> list[tuple[int, ...]]:
    """The cyclic Latin square: `treatments` rows, each treatment once at each place. Rows hold numbers from 0."""
    return [tuple((row + place) % treatments for place in range(treatments)) for row in range(treatments)]


def williams(treatments: int) -> list[tuple[int, ...]]:
    """Williams' design: each treatment equally often at each place and right after each other one.

    Returns:
        As many rows as treatments where they are even in number, twice as many where they are odd.
    """
    first = [0]
    for k in range(1, treatments):
        first.append((k + 1) // 2 if k % 2 else treatments - k // 2)
    rows = [tuple((number + shift) % treatments for number in first) for shift in range(treatments)]
    return rows + [row[::-1] for row in rows] if treatments % 2 and treatments > 1 else rows


def rounds(treatments: int, count: int, order: Order, seed: int, block: int) -> list[Sequence[int]]:
    """The orders of `count` rounds, each of all treatments.

    Args:
        treatments: how many. count: rounds of this visit. seed: draws orders, and which treatment is which of a square.
        block: visits before this one that followed the same square, so that its rows go on from visit to visit.
    """
    if order is Order.STATED or treatments == 0:
        return [range(treatments)] * count
    rng = np.random.default_rng(seed)
    if order is Order.DRAWN:
        return [[int(i) for i in rng.permutation(treatments)] for _ in range(count)]
    named = rng.permutation(treatments)
    rows = latin_square(treatments) if order is Order.LATIN_SQUARE else williams(treatments)
    return [[int(named[i]) for i in rows[(block * count + k) % len(rows)]] for k in range(count)]
