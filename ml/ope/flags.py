"""Typed warnings on an estimate. Pages turn them into sentences."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from typing import Any, Literal

Fact = float | str | tuple[str, ...] | None
Source = Literal["logged", "simulated"]


@dataclass(frozen=True)
class Flag:
    """One finding about an estimate, a policy or a choice.

    Attributes:
        code: what was found, such as `thin`; `wording` of the service knows every code.
        value: what was measured; None where the finding has no number.
        limit: what the value is compared with; None where there is no limit.
        unit: of value and limit: `share`, `sessions`, `controllers`, `reward`, ...; empty without a value.
        refuses: whether the data cannot speak about the policy because of it.
        source: the steps that it is about: `logged` ones, or those that the method `simulated`.
        facts: whatever else a sentence about it needs, by name.
    """

    code: str
    value: float | None = None
    limit: float | None = None
    unit: str = ""
    refuses: bool = False
    source: Source = "logged"
    facts: tuple[tuple[str, Fact], ...] = ()

    @classmethod
    def of(
        cls,
        code: str,
        value: float | None = None,
        limit: float | None = None,
        unit: str = "",
        *,
        refuses: bool = False,
        source: Source = "logged",
        **facts: Fact,
    ) -> Flag:
        """Make a flag with its facts by name."""
        return cls(code, value, limit, unit, refuses, source, tuple(facts.items()))

    def fact(self, name: str) -> Any:
        """Return one of the facts. Raises KeyError where the flag has none of that name."""
        return dict(self.facts)[name]

    @property
    def rounded(self) -> tuple[object, ...]:
        """Equal for two flags that differ by less than anyone would be shown: to two decimals, whatever steps they are about."""
        return (self.code, self.refuses, _round(self.value), tuple((name, _round(v)) for name, v in self.facts))

    def to_json(self) -> dict[str, Any]:
        """Convert every field to JSON."""
        return {
            "code": self.code,
            "value": self.value,
            "limit": self.limit,
            "unit": self.unit,
            "refuses": self.refuses,
            "source": self.source,
            "facts": {name: list(v) if isinstance(v, tuple) else v for name, v in self.facts},
        }

    @classmethod
    def from_json(cls, stored: Mapping[str, Any]) -> Flag:
        """Read what `to_json` made."""
        facts = {name: tuple(v) if isinstance(v, list) else v for name, v in stored["facts"].items()}
        plain = {name: stored[name] for name in ("value", "limit", "unit", "refuses", "source")}
        return cls(stored["code"], **plain, facts=tuple(facts.items()))


FEW_END_REWARDS = Flag("few_end_rewards", None, 3.0, "sessions")
"""Fewer sessions than the limit have an end-of-session reward: the estimate is the step return alone."""

DAYS_UNKNOWN = Flag("days_unknown")
"""These sessions do not show how returns differ from day to day: the intervals omit it."""


def stopped_sessions(stopped: int, counted: float, measured: float) -> Flag:
    """Flag how much of an estimate depends on sessions that were stopped for the participant's sake.

    Args:
        stopped: sessions. counted, measured: r_end where they count as failures, and where they count as measured.
    """
    return Flag.of("stopped_sessions", float(stopped), None, "sessions", counted=counted, measured=measured)


def not_counted_tests(without_cdbs: int = 0, of_unknown_noise: int = 0, without_policy: int = 0) -> Flag | None:
    """Count sessions of tested policies that the posterior does not know of; None where it knows of all.

    Args:
        without_cdbs: at visits without a cDBS session. of_unknown_noise: with a quantity whose scatter between sessions is unknown.
            without_policy: of policies that cannot be replayed. Their file is gone, or they take other windows.
    """
    number = without_cdbs + of_unknown_noise + without_policy
    why = {"without_cdbs": without_cdbs, "of_unknown_noise": of_unknown_noise, "without_policy": without_policy}
    flag = Flag("tests_not_counted", float(number), None, "sessions", facts=tuple((name, float(n)) for name, n in why.items()))
    return flag if number else None


def distinct(flags: Iterable[Flag]) -> tuple[Flag, ...]:
    """Return the flags in their order, each once; two that look equal when shown are one."""
    seen: dict[tuple[object, ...], Flag] = {}
    for flag in flags:
        seen.setdefault((flag.source, *flag.rounded), flag)
    return tuple(seen.values())


def _round(value: Fact) -> Fact:
    return round(value, 2) if isinstance(value, float) else value
