"""The picture of the ranking: what each candidate asks for at which beta, where sessions have been, and what to expect of its dose."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup

from app.evaluation.ranking.answer import QUANTITIES, Answer, Row, map_of
from app.evaluation.ranking.assessment import Assessed, Assessment
from app.platform.numbers import number
from app.platform.web.charts import Cell, written
from app.platform.web.svg import Plane, apart, drawing, glyph
from app.study.margins import margins_of
from app.tables.participants import MarginsVersion
from ml.designs import Bound
from ml.ope import DOSES, BehaviourMap, Estimate, interval, outcome_draws
from ml.outcomes import OUTCOMES

MOST = 8
"""Behaviours that have a line in their colour, with their name; more would hide each other, and are thin. Every candidate has its dot."""

TONES = {"test": "good", "test_with_care": "warn", "undecided": "accent", "cannot_tell": "accent"}
TONES |= {"likely_worse": "bad", "unsafe": "bad", "not_advised": "bad", "same_as_cdbs": "muted"}
LIGHTEST, DARKEST = 0.10, 0.40
"""Opacity of a cell of one recorded step, and of the one with most; over the darkest every line still has three times its luminance."""
DASHES = ("", "8 4", "2 4", "10 3 2 3")
"""Of candidates with one colour, so that colour is never the only sign."""
_GREY = TONES["same_as_cdbs"]
SHAPES = ("circle", "diamond", "square", "up", "down")
_PANELS = {
    "energy": ("Energy, % of cDBS", 100.0),
    **{o.field: (f"{o.short}, {o.sentence_unit}", 1.0) for o in OUTCOMES},
}
W, H = 620.0, 400.0
PANEL_W, PANEL_H = 235.0, 120.0


@dataclass(frozen=True)
class Scale:
    """Amplitudes as the picture shows them: mA, or % of cDBS where the cDBS amplitude is not known.

    Attributes:
        factor: of a fraction of the cDBS amplitude. unit: of the product.
    """

    factor: float
    unit: str

    @classmethod
    def of(cls, cdbs_ma: float | None) -> Scale:
        """Choose the scale by the cDBS amplitude, mA."""
        return cls(100.0, "% of cDBS") if cdbs_ma is None else cls(cdbs_ma, "mA")

    def words(self, fraction: float) -> str:
        """Write an amplitude with its unit."""
        digits = 0 if self.unit.startswith("%") else 1
        return f"{self.factor * fraction:.{digits}f} {self.unit}"


@dataclass(frozen=True)
class Drawn:
    """One candidate as both figures draw it.

    Attributes:
        twin: whether it does the same as another candidate: it has a dot, and no line of its own.
    """

    name: str
    policy_id: int
    tone: str
    dash: str
    shape: str
    estimate: Estimate | None
    limit: float | None
    twin: bool


@dataclass(frozen=True)
class Picture:
    """Both figures and the numbers behind them.

    Attributes:
        behaviour: amplitude against beta; None where the evaluation has no map of behaviours.
        doses: what each dose is expected to do; None without any.
        behaviour_columns, behaviour_rows, dose_columns, dose_rows: tables.
        lines, thin_lines: behaviours whose line has a name and a colour, and those whose has none.
        greyed: whether some act like cDBS, and are grey.
    """

    behaviour: Markup | None
    doses: Markup | None
    behaviour_columns: tuple[str, ...]
    behaviour_rows: tuple[tuple[Cell, ...], ...]
    dose_columns: tuple[str, ...]
    dose_rows: tuple[tuple[Cell, ...], ...]
    lines: int
    thin_lines: int
    greyed: bool


def picture(found: Assessment, rows: Sequence[Row], unit: str, bound: Bound) -> Picture:
    """Draw the picture of some candidates.

    Args:
        found: the assessment. rows: candidates, what matters first. unit: of beta. bound: B, fraction of cDBS.
    """
    scale = Scale.of(found.cdbs_ma)
    everyone = _drawn(rows)
    behaviours = [d for d in everyone if not d.twin]
    known = map_of(found.evaluation)
    named = {str(d.policy_id): d.name for d in behaviours}
    references = sorted(
        (a for a in found.references if a.reference in ("cdbs", "constant", "best_constant") and _dose(a.posterior) is not None),
        key=lambda a: _dose(a.posterior) or 0.0,
    )
    return Picture(
        behaviour=_behaviour(known, behaviours, scale, unit, bound) if known else None,
        doses=_doses(everyone, references, scale),
        behaviour_columns=(f"Beta from ({unit})", f"to ({unit})", "Recorded steps", *(f"{n} ({scale.unit})" for n in named.values())),
        behaviour_rows=_behaviour_rows(known, list(named), scale) if known else (),
        dose_columns=("Policy", f"Mean amplitude ({scale.unit})", *(t for t, _ in _PANELS.values())),
        dose_rows=tuple(_dose_row(name, e, scale) for name, e in _listed(everyone, references)),
        lines=min(MOST, len(behaviours)),
        thin_lines=max(0, len(behaviours) - MOST),
        greyed=any(d.tone == _GREY for d in everyone),
    )


def _drawn(rows: Sequence[Row]) -> list[Drawn]:
    found, seen = [], dict.fromkeys(TONES.values(), 0)
    for row in rows:
        tone = TONES[row.decided.standing]
        nth = seen[tone]
        seen[tone] += 1
        look = tone, DASHES[nth % len(DASHES)], SHAPES[nth % len(SHAPES)]
        for own in (row, *row.twins):
            policy = own.one.policy
            found.append(Drawn(policy.name, policy.id, *look, own.one.posterior, own.limit, twin=own is not row))
    return found


def _behaviour(known: BehaviourMap, behaviours: Sequence[Drawn], scale: Scale, unit: str, bound: Bound) -> Markup:
    shown, more = behaviours[:MOST], behaviours[MOST:]
    plane = Plane(56, 34, W - 56 - 108, H - 34 - 46, (known.edges[0], known.edges[-1]), (0.0, 1.08 * scale.factor))
    most = max((n for column in known.tried for n in column), default=0)
    for k, column in enumerate(known.tried):
        for row, n in enumerate(column):
            if n:
                dark = LIGHTEST + (DARKEST - LIGHTEST) * float(np.log1p(n) / np.log1p(most))
                low, high = row / DOSES * scale.factor, (row + 1) / DOSES * scale.factor
                plane.cell(known.edges[k], known.edges[k + 1], low, high, "muted", dark)
    plane.axes(f"Beta, mean of the policy's window ({written(unit)})", f"Amplitude ({scale.unit})")
    plane.level(scale.factor, f"cDBS {scale.words(1.0)}", "cdbs")
    plane.level(bound * scale.factor, f"lowest of random sessions {scale.words(bound)}", "muted", "2 3")
    centres = [(a + b) / 2 for a, b in zip(known.edges[:-1], known.edges[1:], strict=True)]
    ends: list[tuple[Drawn, float]] = []
    for d in reversed(behaviours):  # what matters first is on top
        curve = known.policies.get(str(d.policy_id))
        if curve is None:
            continue
        values = [None if v is None else v * scale.factor for v in curve.middle]
        points = list(zip(centres, values, strict=True))
        if d in more:
            plane.line(points, "muted", 0.75, words=d.name)
            continue
        plane.line(points, d.tone, 1.5 if d.tone == _GREY else 2.5, d.dash)
        last = next((v for v in reversed(values) if v is not None), None)
        if last is not None:
            ends.append((d, plane.at_y(last)))
        if d.limit is not None:
            plane.level(d.limit * scale.factor, f"{d.name}: not below {scale.words(d.limit)}", "warn", "6 3")
    places = apart([y for _, y in ends], low=plane.top, high=plane.top + plane.height)
    for (d, y), at in zip(ends, places, strict=True):
        right = plane.left + plane.width
        plane.parts.append(
            f'<path d="M{right:.1f} {y:.1f}L{right + 10:.1f} {at:.1f}" fill="none" stroke="var(--c-{d.tone})" stroke-width="1"/>'
        )
        plane.mark(right + 16, at, d.tone, d.shape)
        plane.text(right + 25, at + 4, d.name, colour=d.tone, weight=600)
    told = "; ".join(d.name for d in shown)
    if more:
        told += f". Thin lines: {'; '.join(d.name for d in more)}"
    return drawing(W, H, "Amplitude against beta", f"Lines: {told}. Grey: where recorded sessions have been.", [plane])


def _doses(shown: Sequence[Drawn], references: Sequence[Assessed], scale: Scale) -> Markup | None:
    planes = []
    present = [q for q in QUANTITIES if any(_predicted(e, q) is not None for _, e in _listed(shown, references))]
    for k, name in enumerate(present):
        title, factor = _PANELS[name]
        left, top = 52 + (k % 2) * (PANEL_W + 62), 34 + (k // 2) * (PANEL_H + 78)
        spans = [p for _, e in _listed(shown, references) for p in [_predicted(e, name)] if p is not None]
        low, high = min(p[1] for p in spans) * factor, max(p[2] for p in spans) * factor
        room = 0.06 * ((high - low) or 1.0)
        plane = Plane(left, top, PANEL_W, PANEL_H, (0.0, 1.05 * scale.factor), (max(0.0, low - room), high + room))
        plane.axes(f"Mean amplitude ({scale.unit})", title, y_ticks=4)
        held = [(d * scale.factor, p) for a in references for d, p in [(_dose(a.posterior), _predicted(a.posterior, name))] if d and p]
        plane.line([(x, p[0] * factor) for x, p in held], "cdbs", 1.5, "4 3")
        for x, p in held:
            plane.dot(x, p[0] * factor, "cdbs", "ring", f"held at {number(x)} {scale.unit}: {number(p[0] * factor)}")
        for d in reversed(shown):
            dose, span = _dose(d.estimate), _predicted(d.estimate, name)
            if dose is not None and span is not None:
                value, low_end, high_end = (v * factor for v in span)
                plane.interval(dose * scale.factor, low_end, high_end, d.tone)
                plane.dot(
                    dose * scale.factor, value, d.tone, d.shape, f"{d.name}: {number(value)} ({number(low_end)} to {number(high_end)})"
                )
        planes.append(plane)
    if not planes:
        return None
    height = 34 + ((len(planes) + 1) // 2) * (PANEL_H + 78) - 30
    told = "; ".join(d.name for d in shown)
    return drawing(W, height, "What a dose is expected to do", f"Dots with intervals: {told}. Line: held amplitudes.", planes)


def _listed(shown: Sequence[Drawn], references: Sequence[Assessed]) -> list[tuple[str, Estimate | None]]:
    return [(d.name, d.estimate) for d in shown] + [(a.policy.name, a.posterior) for a in references]


def _dose(estimate: Estimate | None) -> float | None:
    """Return the mean amplitude that a policy requests, fraction of cDBS."""
    value = ((estimate.details.get("behaviour") or {}) if estimate is not None else {}).get("mean_amplitude")
    return None if value is None else float(value)


def _predicted(estimate: Estimate | None, name: str) -> tuple[float, float, float] | None:
    """Return a predicted quantity with its 90 % interval."""
    draws = outcome_draws(estimate, name) if estimate is not None else None
    if draws is None:
        return None
    return float(draws.mean()), *interval(draws)


def _behaviour_rows(known: BehaviourMap, policies: Sequence[str], scale: Scale) -> tuple[tuple[Cell, ...], ...]:
    curves = [known.policies.get(i) for i in policies]
    asked = [[None if c is None or c.middle[k] is None else c.middle[k] for c in curves] for k in range(len(known.tried))]
    return tuple(
        (known.edges[k], known.edges[k + 1], sum(column), *(None if v is None else scale.factor * v for v in asked[k]))
        for k, column in enumerate(known.tried)
    )


def _dose_row(name: str, estimate: Estimate | None, scale: Scale) -> tuple[Cell, ...]:
    dose = _dose(estimate)
    cells: list[Cell] = [name, None if dose is None else scale.factor * dose]
    for quantity, (_, factor) in _PANELS.items():
        span = _predicted(estimate, quantity)
        cells.append(None if span is None else "{} ({} to {})".format(*(number(factor * v) for v in span)))
    return tuple(cells)


# Strips of the candidates' table: each expected change from cDBS with its interval and margin, and the results of visits.

STRIP_W, STRIP_H = 104.0, 16.0
ROOM = 0.05
"""Of the span of a scale, at each end."""


@dataclass(frozen=True)
class Strips:
    """Strips of the table of candidates; a column has one scale.

    Attributes:
        scales: lowest and highest difference, by quantity. limits: the margin of an outcome as a difference; absent where
            it is not known.
    """

    scales: Mapping[str, tuple[float, float]]
    limits: Mapping[str, float]

    def draw(self, row: Row, quantity: str) -> Markup:
        """Draw the strip of a row: cDBS dashed, the margin in red, interval and mark, and a ring for each visit that measured it."""
        plane = Plane(4, 2, STRIP_W - 8, STRIP_H - 4, self.scales[quantity], (0.0, 1.0))
        plane.line([(0.0, 0.0), (0.0, 1.0)], "muted", 1, "2 2")
        if quantity in self.limits:
            plane.line([(self.limits[quantity], 0.0), (self.limits[quantity], 1.0)], "bad", 2)
        tone = TONES[row.decided.standing]
        if quantity in row.differences:
            expected = row.differences[quantity]
            plane.line([(expected.low, 0.5), (expected.high, 0.5)], tone, 2)
            plane.dot(expected.value, 0.5, tone, radius=4)
        for value in _visit_differences(row, quantity):
            plane.dot(value, 0.5, "text", "ring", radius=3)
        return glyph(plane)


def make_strips(answer: Answer, margins: MarginsVersion) -> Strips:
    """Return the strips of an answer's rows, of the folded ones and the best fixed amplitude too.

    Args:
        answer: with all its rows. margins: in force.
    """
    rows = [*answer.rows, *answer.like_cdbs, *answer.like_off, *([answer.fixed.row] if answer.fixed is not None else [])]
    amounts, limits = margins_of(margins), {}
    for o in OUTCOMES:
        usual = answer.under_cdbs.get(o.field)
        if usual is not None:
            amount = o.margin.amount(amounts.of(o), usual)
            limits[o.field] = -amount if o.higher_is_better else amount
    scales = {}
    for name in QUANTITIES:
        expected = [row.differences[name] for row in rows if name in row.differences]
        ends = [
            0.0,
            limits.get(name, 0.0),
            *(v for d in expected for v in (d.low, d.high)),
            *(v for row in rows for v in _visit_differences(row, name)),
        ]
        room = ROOM * ((max(ends) - min(ends)) or 1.0)
        scales[name] = (min(ends) - room, max(ends) + room)
    return Strips(scales, limits)


def _visit_differences(row: Row, quantity: str) -> list[float]:
    """List the differences that the visits of a row's policies measured; those of twins are theirs."""
    visits = row.one.tested.visits if row.one.tested is not None else []
    return [value for visit in visits if (value := getattr(visit, f"{quantity}_difference")) is not None]
