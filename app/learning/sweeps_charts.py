"""Parallel coordinates of a sweep: one line per policy from its hyper-parameters to its results, coloured by its standing."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

from markupsafe import Markup

from app.learning.schemas import ALGORITHM_NAMES
from app.learning.sweeps import Candidate, held_near
from app.platform.numbers import counted, stated
from app.platform.web.charts import Cell
from app.platform.web.svg import Plane, apart, drawing

W, H, TOP, BOTTOM, LEFT, RIGHT = 1120.0, 400.0, 66.0, 26.0, 96.0, 118.0
LEAST = 2
"""Policies that a comparison needs."""


class Standing(StrEnum):
    """Standing of a policy of a sweep: the first objection that applies."""

    RETIRED = "retired"
    BELOW_TRIED = "below_tried"
    NO_SESSION_NEAR = "no_session_near"
    BEYOND_MARGIN = "beyond_margin"
    ABOVE_CDBS = "above_cdbs"
    NOT_ABOVE_CDBS = "not_above_cdbs"
    UNTOLD = "untold"
    """It was not estimated, or the sessions cannot order policies."""


STANDINGS = {
    Standing.RETIRED: "retired",
    Standing.BELOW_TRIED: "below what the random controller tried",
    Standing.NO_SESSION_NEAR: "no session near",
    Standing.BEYOND_MARGIN: "probably beyond a margin",
    Standing.ABOVE_CDBS: "estimated above cDBS",
    Standing.NOT_ABOVE_CDBS: "not above cDBS with confidence",
    Standing.UNTOLD: "cannot tell",
}


LOOKS = {
    Standing.ABOVE_CDBS: ("good", ""),
    Standing.NOT_ABOVE_CDBS: ("accent", ""),
    Standing.BELOW_TRIED: ("bad", "8 4"),
    Standing.NO_SESSION_NEAR: ("warn", "2 4"),
    Standing.BEYOND_MARGIN: ("bad", "2 4"),
    Standing.RETIRED: ("muted", "10 3 2 3"),
    Standing.UNTOLD: ("muted", ""),
}
"""Colour and dash of a line."""


@dataclass(frozen=True)
class Axis:
    """One column of the figure.

    Attributes:
        places: place of each policy, from 0 at the bottom to 1; None where it has no value there.
        ticks: place and words.
        cells: of the table behind the figure.
        always: drawn although all policies have one value.
    """

    name: str
    places: list[float | None]
    ticks: list[tuple[float, str]]
    cells: list[Cell]
    always: bool = False


BETWEEN = 0.06
"""Share of a column's height below which two numbers next to it would meet."""


@dataclass(frozen=True)
class Parallel:
    """The figure, the standings that it shows, and the table behind it."""

    figure: Markup
    standings: list[Standing]
    columns: list[str]
    rows: list[list[Cell]]


def standing(candidate: Candidate) -> Standing:
    """Determine the standing of a policy by what its sweep's page says of it."""
    if candidate.policy.retired_reason is not None:
        return Standing.RETIRED
    if candidate.leaves_the_logged_range:
        return Standing.BELOW_TRIED
    if candidate.gain is None or not candidate.by_posterior or not candidate.told:
        return Standing.UNTOLD
    if not candidate.supported:
        return Standing.NO_SESSION_NEAR
    if candidate.beyond:
        return Standing.BEYOND_MARGIN
    return Standing.ABOVE_CDBS if candidate.gain.low > 0 else Standing.NOT_ABOVE_CDBS


def parallel(candidates: Sequence[Candidate]) -> Parallel | None:
    """Draw the figure of a sweep; None of fewer policies than can be compared.

    Args:
        candidates: best first, as the page lists them.
    """
    if len(candidates) < LEAST:
        return None
    axes = [a for a in _axes(candidates) if a.always or len({p for p in a.places if p is not None}) > 1]
    stands = [standing(c) for c in candidates]
    shown = [s for s in LOOKS if s in stands]
    columns = ["Policy", *(a.name for a in axes), "Stands"]
    rows = [[c.policy.name, *(a.cells[k] for a in axes), STANDINGS[stands[k]]] for k, c in enumerate(candidates)]
    return Parallel(_figure(candidates, axes, stands), shown, columns, rows)


def _axes(candidates: Sequence[Candidate]) -> list[Axis]:
    configs = [c.policy.config for c in candidates]
    return [
        _named("Algorithm", [ALGORITHM_NAMES.get(c.policy.algorithm, c.policy.algorithm) for c in candidates]),
        _named("Aim", [{"steps": "steps", "return": "with end reward"}.get(str(g.get("aim", "steps")), "other") for g in configs]),
        _named("Held near", ["recorded" if (near := held_near(g)) == "logged" else near or "nothing" for g in configs]),
        _number("Learning rate", [c.rate for c in candidates], logarithmic=True),
        _number("Rate of the values", [g.get("critic_lr") for g in configs], logarithmic=True),
        _number("Updates", [g.get("updates") for g in configs], logarithmic=True),
        _number("Kept update", [c.best_update for c in candidates]),
        _number("Mean amplitude", [c.mean_amplitude for c in candidates], always=True),
        _number("From recorded", [c.action_distance for c in candidates]),
        _number("Held-out return", [c.score for c in candidates], always=True),
        _number("Gain over cDBS", [c.gain.value if c.gain else None for c in candidates], always=True),
        _number("Energy saved", [c.saves for c in candidates]),
    ]


def _named(name: str, values: Sequence[str]) -> Axis:
    each = sorted(set(values))
    at = {value: (k + 0.5) / len(each) for k, value in enumerate(each)}
    return Axis(name, [at[v] for v in values], [(at[v], v) for v in each], list(values))


def _number(name: str, values: Sequence[float | None], logarithmic: bool = False, always: bool = False) -> Axis:
    """Make a column of numbers; without any it has no place and no tick."""
    known = [float(v) for v in values if v is not None and math.isfinite(v) and (v > 0 or not logarithmic)]
    cells: list[Cell] = [None if v is None else float(v) for v in values]
    if not known:
        return Axis(name, [None] * len(values), [], cells)
    scale: Callable[[float], float] = math.log10 if logarithmic else float
    low, high = scale(min(known)), scale(max(known))
    usable = set(known)

    def place(value: float) -> float:
        return 0.5 if high == low else (scale(value) - low) / (high - low)

    ticks = [min(known), max(known)] if high > low else [low if not logarithmic else min(known)]
    if name == "Gain over cDBS" and low < 0 < high and BETWEEN < place(0.0) < 1 - BETWEEN:
        ticks.insert(1, 0.0)
    return Axis(
        name,
        [place(float(v)) if v is not None and float(v) in usable else None for v in values],
        [(place(t), stated(t, 3)) for t in ticks],
        cells,
        always,
    )


def _figure(candidates: Sequence[Candidate], axes: Sequence[Axis], stands: Sequence[Standing]) -> Markup:
    plane = Plane(LEFT, TOP, W - LEFT - RIGHT, H - TOP - BOTTOM, (0.0, max(len(axes) - 1, 1)), (0.0, 1.0))
    for k, column in enumerate(axes):
        plane.line([(k, 0.0), (k, 1.0)], "border", 1.0)
        # names are in two heights, or those of neighbours meet
        plane.text(plane.at_x(k), TOP - (44 if k % 2 else 26), column.name, "middle", weight=650)
    # the best is drawn last, on top
    for which in reversed(range(len(candidates))):
        tone, dash = LOOKS[stands[which]]
        plane.line([(k, a.places[which]) for k, a in enumerate(axes)], tone, 1.8, dash)
        named = f"{candidates[which].policy.name}: {STANDINGS[stands[which]]}"
        for k, a in enumerate(axes):
            if (place := a.places[which]) is not None:
                plane.dot(k, place, tone, words=f"{named}; {a.name} {_cell(a.cells[which])}")
    for k, column in enumerate(axes):
        for place, text in column.ticks:
            plane.text(plane.at_x(k) - 9, plane.at_y(place) - 7, text, "end", "muted")
    _names(plane, candidates, axes[-1], stands)
    told = f"{counted(len(candidates), 'policy', 'policies')}; the columns are {', '.join(a.name for a in axes)}."
    return drawing(W, H, "Hyper-parameters and what became of them", told, [plane])


def _names(plane: Plane, candidates: Sequence[Candidate], last: Axis, stands: Sequence[Standing]) -> None:
    """Write each policy's name at the end of its line, as far as there is room."""
    ending = [(k, place) for k, place in enumerate(last.places) if place is not None]
    ending = ending[: int((H - TOP - BOTTOM) / 14)]
    wanted = [plane.at_y(place) + 4 for _, place in ending]
    for (k, _), y in zip(ending, apart(wanted, low=TOP, high=H - 8), strict=True):
        plane.text(plane.left + plane.width + 12, y, candidates[k].policy.name[:16], "start", LOOKS[stands[k]][0])


def _cell(value: Any) -> str:
    return "—" if value is None else stated(value, 3) if isinstance(value, float) else str(value)
