"""Methods of off-policy evaluation, one record each: schemas, jobs, pages, charts and comparisons derive from these.

Adding a method takes its own file, with a factory, and one record here. Records name their factories, so that a process which computes
nothing does not load what they need.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Literal

from ml.ope.estimate import Estimator

Family = Literal["model", "value", "density ratio", "importance weights", "combination"]
Size = Literal["full", "demo", "held_out"]
"""`full` for a study, `demo` for a first look, `held_out` where a method is fitted once for each held-out controller."""

Factory = Callable[[str, int, Size], Estimator]
"""Makes the estimator of a key with a seed at a size."""

AGGREGATE = "aggregate"
"""Key of the combination of the others: not fitted, but computed from their estimates."""


POSTERIOR = "posterior"
"""Key of the posterior over policies, which fits its own structures and which rankings follow."""


@dataclass(frozen=True, kw_only=True)
class Method:
    """One method of off-policy evaluation.

    Attributes:
        key: in the API, in jobs and in stored estimates.
        name, short: for people; `short` is for the heads of wide tables.
        family: what it learns.
        needs: what the data must have for it, for people.
        factory: `module:attribute` of a `Factory`; None for the combination.
        held_out: whether it is fitted within seconds, so that it can be refitted without each controller and compared with its sessions.
        by_default: whether it runs where no methods are named: the answer rests on it, or it checks the answer within seconds.
        combines: whether the combination of all takes it where it ran.
        preference: place in the usual order where the data choose no method; None for a method that is never taken by default.
        weight: share of a job's progress that its step takes.
        colour, symbol: of its marks in charts: a colour token of the pages, and a plotly symbol that has an open form.
    """

    key: str
    name: str
    short: str
    family: Family
    needs: str
    factory: str | None
    held_out: bool = False
    by_default: bool = False
    combines: bool = True
    preference: int | None = None
    weight: float = 1.0
    colour: str = "other"
    symbol: str = "circle"


_START, _DENSITY = "a session with a whole beta window before its first step", "sessions whose amplitudes vary"
_IS = "ml.ope.importance:build"

_METHODS: dict[str, Method] = {}


def register(method: Method) -> None:
    """Add a method, before the combination of all.

    Raises:
        ValueError: another method has its key.
    """
    if _METHODS.get(method.key, method) != method:
        raise ValueError(f"two methods of evaluation have the key {method.key!r}")
    _METHODS[method.key] = method


def unregister(key: str) -> None:
    """Take a method away again. Raises KeyError where there is none of that key."""
    del _METHODS[key]


# fmt: off
for _method in (
    Method(key="dlsm", name="DLSM", short="DLSM", family="model", needs="four sessions", factory="ml.ope.dlsm.estimator:build", preference=2, weight=6.0, colour="rl", symbol="diamond"),  # noqa: E501
    Method(key="dlsm_paper", name="DLSM (paper)", short="DLSM (paper)", family="model", needs="four sessions", factory="ml.ope.dlsm.estimator:build_paper", combines=False, weight=8.0, colour="rl", symbol="diamond-wide"),  # noqa: E501
    Method(key="linear", name="Linear model", short="Linear", family="model", needs="two sessions", factory="ml.ope.linear.estimator:build", by_default=True, held_out=True, preference=1, weight=2.0, colour="distilled", symbol="square"),  # noqa: E501
    Method(key="impulse", name="Impulse-response model", short="Impulse", family="model", needs="two sessions", factory="ml.ope.impulse.estimator:build", by_default=True, weight=2.0, colour="good", symbol="hourglass"),  # noqa: E501
    Method(key="dlmm", name="DLMM", short="DLMM", family="model", needs="two sessions", factory="ml.ope.dlmm:build", weight=3.0, colour="accent", symbol="hexagram"),  # noqa: E501
    Method(key="fqe", name="Fitted Q evaluation", short="FQE", family="value", needs=_START, factory="ml.ope.fqe.estimator:build", held_out=True, preference=3, colour="cdbs", symbol="circle"),  # noqa: E501
    Method(key="wdr", name="Weighted doubly robust", short="WDR", family="value", needs=_START, factory="ml.ope.doubly_robust:build", held_out=True, preference=4, weight=2.0, colour="no_dbs", symbol="cross"),  # noqa: E501
    Method(key="dual_dice", name="DualDICE", short="DualDICE", family="density ratio", needs=_START, factory="ml.ope.dual_dice:build", preference=7, weight=3.0, colour="warn", symbol="star"),  # noqa: E501
    Method(key="wis", name="Weighted importance sampling", short="WIS", family="importance weights", needs=_DENSITY, factory=_IS, held_out=True, preference=6, colour="random", symbol="triangle-up"),  # noqa: E501
    Method(key="pdis", name="Per-decision importance sampling", short="PDIS", family="importance weights", needs=_DENSITY, factory=_IS, preference=8, colour="other", symbol="x"),  # noqa: E501
    Method(key="cwpdis", name="Consistent weighted per-decision importance sampling", short="CWPDIS", family="importance weights", needs=_DENSITY, factory=_IS, held_out=True, preference=5, colour="muted", symbol="triangle-down"),  # noqa: E501
    Method(key=POSTERIOR, name="All structures together", short="All structures", family="combination", needs="two sessions", factory="ml.ope.posterior.estimator:build", by_default=True, weight=3.0, colour="info", symbol="star-diamond"),  # noqa: E501
    Method(key=AGGREGATE, name="Combination of all methods", short="Combination", family="combination", needs="two other methods", factory=None, colour="text", symbol="pentagon"),  # noqa: E501
):
    register(_method)
# fmt: on


def methods() -> tuple[Method, ...]:
    """List every method in the order of the pages, the combination last."""
    return tuple(sorted(_METHODS.values(), key=lambda m: m.family == "combination"))


def method_keys() -> tuple[str, ...]:
    """List the keys of `methods`."""
    return tuple(m.key for m in methods())


def shown(key: str) -> Method:
    """Return the record of a key for a page. A stored estimate of a method that this version does not have is named by its key."""
    unknown = Method(key=key, name=key, short=key, family="model", needs="", factory=None)
    return _METHODS.get(key, unknown)


def preference() -> tuple[str, ...]:
    """List the usual order, in which a method is taken for a ranking where the data do not decide; docs/evaluation.md has what is behind
    it."""
    placed = [(m.preference, m.key) for m in methods() if m.preference is not None]
    return tuple(key for _, key in sorted(placed))


def build(key: str, seed: int, size: Size) -> Estimator:
    """Build the estimator of a method.

    Raises:
        ValueError: there is no such method, or it is computed from the others.
    """
    found = _METHODS.get(key)
    if found is None or found.factory is None:
        fitted = ", ".join(m.key for m in methods() if m.factory)
        raise ValueError(f"{key!r} is no method that can be fitted; these can: {fitted}")
    module, attribute = found.factory.split(":")
    factory: Factory = getattr(import_module(module), attribute)
    return factory(key, seed, size)


def estimators(seed: int = 0, *, demo: bool = False) -> dict[str, Estimator]:
    """Build every method that is fitted, at its full size or at that of a demonstration."""
    return {m.key: build(m.key, seed, "demo" if demo else "full") for m in methods() if m.factory}


def quick_estimators(seed: int = 0) -> dict[str, Estimator]:
    """Build the methods that can be fitted once for each held-out controller, at the size for that."""
    return {m.key: build(m.key, seed, "held_out") for m in methods() if m.held_out}
