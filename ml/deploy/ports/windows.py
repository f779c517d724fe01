"""Windows that show what converters break: recorded ones, lost samples, levels, steps, single pulses, large beta, and both ends of the
dose."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Windows = NDArray[np.float64]
Act = Callable[[Windows], NDArray[np.float64]]
"""Amplitude fractions [N] for beta windows [N, W]; NaN where the policy gives none."""

COUNT = 400
"""Windows in a bundle, whatever their length."""
TIMES_LARGEST = (1.5, 2.0, 3.0, 5.0, 7.0, 10.0)
LEVELS = 24
LOST_ONE, LOST_RUN, LOST_ALL = "lost one", "lost run", "lost all"
ZERO, LEVEL, STEP, PULSE, LARGE = "zero", "level", "step", "pulse", "large"
LOWEST, HIGHEST, NEAR, MADE_UP = "lowest dose", "highest dose", "near", "made up"
LOST = (LOST_ONE, LOST_RUN, LOST_ALL)
_MOST_SINGLE, _MOST_RUNS, _MOST_STEPS, _MOST_PULSES, _SHAPES, _ENDS = 120, 44, 12, 24, 4, 12
_TRIED, _ROUNDS = 1500, 40


class Recorded(NamedTuple):
    """Beta windows [M, W] of one visit, and what they are called: `visit 2`, or `made up` where nothing was recorded."""

    kind: str
    windows: Windows


def choose_windows(visits: Sequence[Recorded], act: Act) -> tuple[list[str], Windows]:
    """Choose the windows of a bundle; the same arguments always give the same ones.

    Args:
        visits: complete beta windows by visit, at least one.
        act: the policy.

    Returns:
        The kind of each, and the windows, float32 values of shape [400, W], NaN where a sample is lost.
    """
    whole = np.concatenate([part.windows for part in visits])
    length, largest = whole.shape[1], float(np.abs(whole).max()) or 1.0
    rng = np.random.default_rng(length)
    made: list[tuple[str, Windows]] = [
        *lose_samples(whole),
        (ZERO, np.zeros((1, length))),
        (LEVEL, _levels(whole, largest)),
        (STEP, _steps(whole, largest)),
        (PULSE, _pulses(whole, largest)),
        (LARGE, _large(whole, largest)),
        *_ends(whole, largest, act, rng),
    ]
    room = COUNT - sum(len(rows) for _, rows in made)
    made = [*_real(visits, room), *made]
    missing = COUNT - sum(len(rows) for _, rows in made)
    if missing:
        made.insert(len(visits), (NEAR, mix(whole, missing, rng)))
    kinds = [kind for kind, rows in made for _ in rows]
    return kinds, np.concatenate([rows for _, rows in made]).astype(np.float32).astype(np.float64)


def _spread(items: Sequence[int] | range, most: int) -> list[int]:
    """Choose at most so many items, the first and the last among them."""
    places = np.unique(np.linspace(0, len(items) - 1, min(most, len(items))).astype(int))
    return [items[int(place)] for place in places]


def _real(visits: Sequence[Recorded], room: int) -> Iterable[tuple[str, Windows]]:
    """Spread the room over the visits, and over each visit's windows."""
    left, parts = room, len(visits)
    for index, part in enumerate(sorted(visits, key=lambda part: len(part.windows))):
        chosen = _spread(range(len(part.windows)), left // (parts - index))
        left -= len(chosen)
        yield part.kind, part.windows[chosen]


def lose_samples(whole: Windows) -> Iterable[tuple[str, Windows]]:
    """Drop every place alone, runs of every length, and everything."""
    length = whole.shape[1]
    single = [(place, 1) for place in _spread(range(length), _MOST_SINGLE)]
    runs = [(start, size) for size in range(2, length) for start in range(length - size + 1)]
    runs = [runs[i] for i in _spread(range(len(runs)), _MOST_RUNS)] if runs else []
    for kind, places in ((LOST_ONE, single), (LOST_RUN, runs), (LOST_ALL, [(0, length)])):
        rows = np.array([whole[i % len(whole)] for i in range(len(places))]).reshape(-1, length)
        for row, (start, size) in zip(rows, places, strict=True):
            row[start : start + size] = np.nan
        yield kind, rows


def _levels(whole: Windows, largest: float) -> Windows:
    """Scale one shape from almost nothing to the largest beta: rising, for what must rise or fall with it."""
    shape = whole[int(np.argmax(whole.max(axis=1)))] / largest
    return np.linspace(0.04, 1.0, LEVELS)[:, None] * largest * np.maximum(shape, 0.0)[None, :]


def _steps(whole: Windows, largest: float) -> Windows:
    """Make steps up and down at every place, between a low and the largest beta."""
    length, low = whole.shape[1], float(np.quantile(whole, 0.1))
    ramp = 1.0 + 1e-3 * np.arange(length)  # no two values are equal, so that none counts as frozen
    rows = [np.where(np.arange(length) < place, low, largest) * ramp for place in _spread(range(length), _MOST_STEPS)]
    return np.array([*rows, *(row[::-1] for row in rows)])


def _pulses(whole: Windows, largest: float) -> Windows:
    """Set one place to the largest beta and all others to the middle, for each place: a copy that reads in another order shows."""
    length = whole.shape[1]
    rows = np.full((length, length), float(np.median(whole))) * (1.0 + 1e-3 * np.arange(length))
    np.fill_diagonal(rows, largest)
    return np.asarray(rows[_spread(range(length), _MOST_PULSES)])


def _large(whole: Windows, largest: float) -> Windows:
    """Scale recorded shapes to several times the largest beta."""
    shapes = whole[_spread(range(len(whole)), _SHAPES)]
    tops = np.abs(shapes).max(axis=1, keepdims=True)
    shapes = np.abs(shapes) / np.where(tops > 0, tops, 1.0)
    return np.concatenate([largest * times * shapes for times in TIMES_LARGEST])


def _ends(whole: Windows, largest: float, act: Act, rng: np.random.Generator) -> Iterable[tuple[str, Windows]]:
    """Search windows up to the largest beta for the lowest and the highest dose."""
    length = whole.shape[1]
    tried = np.concatenate([whole[_spread(range(len(whole)), _TRIED)], rng.uniform(0.0, largest, (_TRIED, length))])
    tried = np.abs(tried)
    for kind, sign in ((LOWEST, 1.0), (HIGHEST, -1.0)):
        best, score = _first(tried, act, sign)
        for _ in range(_ROUNDS):
            moved = np.repeat(best, 8, axis=0)
            swapped = rng.random(moved.shape) < 1.5 / length
            moved[swapped] = rng.uniform(0.0, largest, int(swapped.sum()))
            better, found = _first(np.concatenate([best, moved]), act, sign)
            if found[0] >= score[0] - 1e-7 and found[-1] >= score[-1] - 1e-7:
                break
            best, score = better, found
        yield kind, best


def _first(windows: Windows, act: Act, sign: float) -> tuple[Windows, NDArray[np.float64]]:
    """Keep the windows of lowest (sign 1) or highest (sign -1) dose, with their scores, best first."""
    rows = np.unique(windows, axis=0)
    scores = np.nan_to_num(sign * act(rows), nan=np.inf)
    order = np.argsort(scores, kind="stable")[:_ENDS]
    return rows[order], scores[order]


def mix(whole: Windows, count: int, rng: np.random.Generator) -> Windows:
    """Mix pairs of recorded windows, where too few were recorded."""
    one, other = whole[rng.integers(len(whole), size=count)], whole[rng.integers(len(whole), size=count)]
    share = rng.random((count, 1))
    return np.asarray((share * one + (1 - share) * other) * rng.uniform(0.8, 1.2, one.shape))
