"""The five metrics in the units of pages and figures: energy in % of cDBS, as on every other page; files and the API keep its share."""

from __future__ import annotations

from dataclasses import replace

from app.analysis import wording
from app.analysis.metrics.comparisons import Comparison, Group
from app.analysis.metrics.service import FiveMetrics, MetricResult, PolicyResult


def for_readers(found: FiveMetrics) -> FiveMetrics:
    """The same analysis with every metric in the unit in which it is shown."""
    return replace(found, metrics=[_metric(m) for m in found.metrics])


def _metric(m: MetricResult) -> MetricResult:
    factor = wording.shown_factor(m.metric)
    if factor == 1.0:
        return m
    return replace(
        m,
        unit=wording.shown_unit(m.metric, m.unit),
        groups=[_group(g, factor) for g in m.groups],
        comparisons=[_comparison(c, factor) for c in m.comparisons],
        policies=[PolicyResult(p.policy_id, _group(p.group, factor), _comparison(p.comparison, factor)) for p in m.policies],
    )


def _group(g: Group, factor: float) -> Group:
    q1, median, q3 = (None if v is None else factor * v for v in (g.q1, g.median, g.q3))
    return replace(g, q1=q1, median=median, q3=q3, values=tuple(factor * v for v in g.values))


def _comparison(c: Comparison, factor: float) -> Comparison:
    difference, low, high = (None if v is None else factor * v for v in (c.difference, c.low, c.high))
    return replace(c, difference=difference, low=low, high=high)
