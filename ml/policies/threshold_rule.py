"""Threshold rules: adaptive stimulation as implants on the market run it, with their settings, limits and time steps.

One rule has two thresholds of beta power and two amplitudes. Above the upper threshold the amplitude rises to the upper limit, below the
lower one it falls to the lower limit. In between a dual rule keeps it; a single rule (both thresholds equal) always moves to a limit.

Sources. Ranges: FDA, Summary of Safety and Effectiveness Data P960009/S478 (2025), Table 2. Defaults, ramps and onset timers: Stanslaski et
al., npj Parkinson's Disease 10:174 (2024). Updates per second: Bronte-Stewart et al., JAMA Neurology (2025). Amplitude steps: Cascino et
al., npj Parkinson's Disease (2026). Thresholds at quartiles: Busch et al., npj Parkinson's Disease 11 (2025).

Not published, and assumed here:

* a power at a threshold is not beyond it, and a timer counts the updates that it has seen;
* the amplitude is the nearest step of the device;
* averaging is a moving mean;
* blanking keeps the direction that began it, while timers count on.

The answer of the device to a lost sample is not published either. So a missing power gives the range of amplitudes that any power leads to.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, fields
from typing import Any, Final, Literal

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Mode = Literal["dual", "single"]

UPDATE_S: Final[dict[Mode, float]] = {"dual": 0.2, "single": 0.05}
"""Seconds between two decisions of the device: 5 and 20 a second."""
BLANKING_S: Final[dict[Mode, float]] = {"dual": 2.0, "single": 0.55}
"""Default detection blanking, from session reports and Stanslaski et al.; its range is not published."""
ONSET_S: Final[dict[Mode, tuple[float, float]]] = {"dual": (0.0, 360.0), "single": (0.0, 30.0)}
RAMP_S: Final = (0.25, 1800.0)
LIMIT_MA: Final = (0.0, 25.5)
AVERAGING_S: Final = (0.0, 30.0)
"""From the tip card of the sensing software (2020): the table of the FDA does not list it."""
STEP_MA: Final = 0.1
"""Step of a Percept PC; a Percept RC has 0.01 mA, which holds every amplitude of the coarser one."""
_SMALL = 1e-9


class RuleError(ValueError):
    """The settings are no rule that the device can run; says which one, and how to correct it.

    Attributes:
        field: of `ThresholdRule`.
    """

    def __init__(self, field: str, message: str) -> None:
        super().__init__(message)
        self.field = field


@dataclass(frozen=True, kw_only=True)
class ThresholdRule:
    """Settings of one rule.

    Attributes:
        mode: `dual` or `single`. lower_threshold, upper_threshold: of beta power, in its unit; equal in a single rule.
        lower_ma, upper_ma: amplitude limits. ramp_up_s, ramp_down_s: time from one limit to the other.
        onset_s, termination_s: how long power must be above the upper, or below the lower threshold, before the amplitude moves. Reports
            call them `UpperThresholdOnset` and `LowerThresholdOnset`.
        averaging_s: moving mean of power. blanking_s: time after a new direction in which it cannot change. step_ma: of the device.

    Raises:
        RuleError: crossed thresholds or limits, or a value outside the range of the device.
    """

    mode: Mode
    lower_threshold: float
    upper_threshold: float
    lower_ma: float
    upper_ma: float
    ramp_up_s: float
    ramp_down_s: float
    onset_s: float
    termination_s: float
    averaging_s: float
    blanking_s: float
    step_ma: float = STEP_MA

    def __post_init__(self) -> None:
        if self.mode not in UPDATE_S:
            raise RuleError("mode", f"there is no mode '{self.mode}'; use dual or single")
        for name in (f.name for f in fields(self) if f.name != "mode"):
            if not np.isfinite(getattr(self, name)):
                raise RuleError(name, f"{_words(name)} is not a number; state it")
        if self.lower_threshold < 0:
            raise RuleError("lower_threshold", f"a lower threshold of {self.lower_threshold:g} is below 0, and power never is; raise it")
        if self.mode == "dual" and not self.lower_threshold < self.upper_threshold:
            what = f"the lower threshold ({self.lower_threshold:g}) is not below the upper one ({self.upper_threshold:g})"
            raise RuleError("lower_threshold", f"{what}; exchange them, or choose a single threshold where they are equal")
        if self.mode == "single" and self.lower_threshold != self.upper_threshold:
            raise RuleError("upper_threshold", "a single rule has one threshold; state the same as lower and upper one")
        for name in ("lower_ma", "upper_ma"):
            _check_range(self, name, LIMIT_MA, "mA")
            if abs(getattr(self, name) / self.step_ma - round(getattr(self, name) / self.step_ma)) > 1e-6:
                raise RuleError(name, f"{_words(name)} of {getattr(self, name):g} mA is no multiple of {self.step_ma:g} mA; round it")
        if self.lower_ma > self.upper_ma:
            raise RuleError(
                "lower_ma", f"the lower limit ({self.lower_ma:g} mA) is above the upper one ({self.upper_ma:g} mA); exchange them"
            )
        for name, limits in (("ramp_up_s", RAMP_S), ("ramp_down_s", RAMP_S), ("averaging_s", AVERAGING_S)):
            _check_range(self, name, limits, "s")
        for name in ("onset_s", "termination_s"):
            _check_range(self, name, ONSET_S[self.mode], "s")
        if self.blanking_s < 0:
            raise RuleError("blanking_s", f"a blanking of {self.blanking_s:g} s is below 0; state 0 or more")

    @property
    def update_s(self) -> float:
        """Seconds between two decisions."""
        return UPDATE_S[self.mode]

    @property
    def up_ma_per_s(self) -> float:
        """Rise while power is high, mA per second."""
        return (self.upper_ma - self.lower_ma) / self.ramp_up_s

    @property
    def down_ma_per_s(self) -> float:
        """Fall while power is low, mA per second."""
        return (self.upper_ma - self.lower_ma) / self.ramp_down_s

    def require_within(self, low_ma: float, high_ma: float) -> None:
        """Raise RuleError where a limit leaves the amplitudes that a participant may get; nothing is cut to fit."""
        if self.upper_ma > high_ma + _SMALL:
            what = f"the upper limit of {self.upper_ma:g} mA is above {high_ma:g} mA, the most that this participant may get"
            raise RuleError("upper_ma", f"{what}; lower it")
        if self.lower_ma < low_ma - _SMALL:
            what = f"the lower limit of {self.lower_ma:g} mA is below {low_ma:g} mA, the least that this participant may get"
            raise RuleError("lower_ma", f"{what}; raise it")

    def deliver(self, share: Floats) -> Floats:
        """Convert the way from the lower limit (0) to the upper one (1) into delivered amplitudes, mA, in steps of the device."""
        range_ma = self.upper_ma - self.lower_ma
        return np.minimum(self.lower_ma + self.step_ma * np.floor(share * range_ma / self.step_ma + 0.5 + _SMALL), self.upper_ma)

    def to_json(self) -> dict[str, Any]:
        """Return the settings by name."""
        return asdict(self)

    @classmethod
    def from_json(cls, values: Mapping[str, Any]) -> ThresholdRule:
        """Read what `to_json` wrote; other keys are ignored. Raises RuleError as the class does."""
        return cls(**{f.name: values[f.name] for f in fields(cls)})


def _words(name: str) -> str:
    return "the " + name.removesuffix("_ma").removesuffix("_s").replace("_", " ") + (" limit" if name.endswith("_ma") else "")


def _check_range(rule: ThresholdRule, name: str, limits: tuple[float, float], unit: str) -> None:
    value = getattr(rule, name)
    if not limits[0] - _SMALL <= value <= limits[1] + _SMALL:
        bounds = f"{limits[0]:g} to {limits[1]:g} {unit}"
        raise RuleError(name, f"{_words(name)} of {value:g} {unit} is outside what the device takes, {bounds}; state one within it")


class RuleRun:
    """Rules at work, one a row: the state of each between two updates of the device.

    Args:
        rules: one for each row, or one for all. They have one mode and one averaging.
        rows: number of rows. start: where each begins on the way from the lower limit (0) to the upper one (1), [rows].

    Raises:
        ValueError: rules of several modes or averaging durations.
    """

    def __init__(self, rules: Sequence[ThresholdRule], rows: int, start: Floats) -> None:
        if len({(r.mode, r.averaging_s) for r in rules}) != 1:
            raise ValueError("rules that run together need one mode and one averaging duration")
        dt = rules[0].update_s
        self._dual = rules[0].mode == "dual"

        def each(values: list[float]) -> Floats:
            return np.broadcast_to(np.array(values, dtype=np.float64), (rows,))

        self._lower, self._upper = each([r.lower_threshold for r in rules]), each([r.upper_threshold for r in rules])
        self._up, self._down = each([dt / r.ramp_up_s for r in rules]), each([dt / r.ramp_down_s for r in rules])
        self._onset = each([max(1, _updates(r.onset_s, dt)) for r in rules])
        self._termination = each([max(1, _updates(r.termination_s, dt)) for r in rules])
        self._blanking = each([_updates(r.blanking_s, dt) for r in rules])
        self._recent = np.full((max(1, _updates(rules[0].averaging_s, dt)), rows), np.nan)
        self._sum = np.zeros(rows)
        self._seen = 0
        self._above, self._below, self._blank, self._direction = (np.zeros(rows) for _ in range(4))
        self.share = np.asarray(start, dtype=np.float64).copy()
        """Way from the lower limit (0) to the upper one (1), [rows]."""

    def remember(self, power: Floats) -> Floats:
        """Take in one power [rows] and return the moving mean; nothing is decided."""
        at = self._seen % len(self._recent)
        before = self._recent[at].copy()
        self._recent[at] = power
        self._seen += 1
        if at == 0 or not np.isfinite(power).all() or not np.isfinite(self._sum).all():
            self._sum = self._recent[: self._seen].sum(axis=0)  # so that rounding does not add up
        else:
            self._sum = self._sum + power - (before if self._seen > len(self._recent) else 0.0)
        return np.asarray(self._sum / min(self._seen, len(self._recent)))

    def update(self, power: Floats) -> Floats:
        """Decide on the power of one update, [rows], and return the way from the lower limit to the upper one, [rows]."""
        mean = self.remember(power)
        self._above = np.where(mean > self._upper, self._above + 1, 0)
        self._below = np.where(mean < self._lower, self._below + 1, 0)
        otherwise = 0.0 if self._dual else self._direction
        asked = np.where(self._above >= self._onset, 1.0, np.where(self._below >= self._termination, -1.0, otherwise))
        asked = np.where(self._blank > 0, self._direction, asked)
        begins = (asked != self._direction) & (asked != 0)
        self._blank = np.where(begins, self._blanking, np.maximum(self._blank - 1, 0))
        self._direction = asked
        moved = self.share + np.where(asked > 0, self._up, np.where(asked < 0, -self._down, 0.0))
        self.share = np.clip(moved, 0.0, 1.0)
        return self.share


def _updates(seconds: float, dt: float) -> int:
    """Count the updates that a duration takes, rounded up."""
    return int(np.ceil(seconds / dt - 1e-6))


@dataclass(frozen=True)
class RuleTrace:
    """Amplitudes that a rule gave.

    Attributes:
        amplitude_ma: after each update, [T]; NaN where a missing power leaves it open.
        low_ma, high_ma: least and most that it may have been.
    """

    amplitude_ma: Floats
    low_ma: Floats
    high_ma: Floats


def simulate(rule: ThresholdRule, power: Floats, start_ma: float) -> RuleTrace:
    """Run a rule over powers at the updates of the device.

    Args:
        power: of each update, [T]; NaN where it is not known. start_ma: amplitude before the first one, within the limits.

    Raises:
        RuleError: an amplitude to start from outside the limits.
    """
    values = np.asarray(power, dtype=np.float64)
    missing = np.isnan(values)
    both = np.stack([np.where(missing, -np.inf, values), np.where(missing, np.inf, values)])
    run = RuleRun([rule], 2, np.full(2, start_share(rule, start_ma)))
    shares = np.stack([run.update(both[:, k]) for k in range(values.size)]) if values.size else np.empty((0, 2))
    low, high = rule.deliver(shares).T
    return RuleTrace(np.where(low == high, low, np.nan), np.minimum(low, high), np.maximum(low, high))


def start_share(rule: ThresholdRule, start_ma: float) -> float:
    """Convert an amplitude within the limits to the way from the lower to the upper one. Raises RuleError outside them."""
    if not rule.lower_ma - _SMALL <= start_ma <= rule.upper_ma + _SMALL:
        raise RuleError("lower_ma", f"a start at {start_ma:g} mA is outside the limits, {rule.lower_ma:g} to {rule.upper_ma:g} mA")
    range_ma = rule.upper_ma - rule.lower_ma
    return (start_ma - rule.lower_ma) / range_ma if range_ma > 0 else 1.0


class ThresholdPolicy:
    """A rule as a policy: at every step of the study it runs the updates of the device, with the newest beta as their power.

    It remembers more than a window, so `begin` starts sessions. Each call of `act` on its result is the next step of the same rows.
    `act` without that answers what the rule would settle at, the limit that the newest crossing of a threshold leads to.

    A session begins at the upper limit, that nearest to cDBS. Beta of the step under way is not known yet; the rule sees it one step late.

    Args:
        rule: settings. cdbs_ma: amplitude of which answers are fractions. period_s: of a step.

    Raises:
        RuleError: an upper limit above cDBS. ValueError: a period that is no whole number of updates.
    """

    def __init__(self, rule: ThresholdRule, cdbs_ma: float, period_s: float) -> None:
        rule.require_within(0.0, cdbs_ma)
        count = round(period_s / rule.update_s)
        if count < 1 or abs(count * rule.update_s - period_s) > 1e-6:
            raise ValueError(f"a step of {period_s:g} s is no whole number of the device's updates of {rule.update_s:g} s")
        self.rule, self.cdbs_ma, self.period_s, self.updates = rule, cdbs_ma, period_s, count

    def begin(self) -> RunningRule:
        """Start sessions."""
        return RunningRule(self)

    def act(self, states: NDArray[Any]) -> Floats:
        """Compute what the rule settles at, as fractions [N]; the upper limit where no beta of the window is beyond a threshold."""
        states = np.asarray(states, dtype=np.float64)
        crossed = np.where(states > self.rule.upper_threshold, 1, np.where(states < self.rule.lower_threshold, -1, 0))[:, ::-1]
        newest = crossed[np.arange(len(states)), np.argmax(crossed != 0, axis=1)]
        return np.where(newest >= 0, self.rule.upper_ma, self.rule.lower_ma) / self.cdbs_ma


class RunningRule:
    """Sessions under a rule, in step.

    Attributes:
        mean_square: of the fractions within the newest step, [N], for an energy without the error of averaging first.
    """

    def __init__(self, policy: ThresholdPolicy) -> None:
        self._policy = policy
        self._run: RuleRun | None = None
        self.mean_square: Floats = np.empty(0)

    def act(self, states: NDArray[Any]) -> Floats:
        """Return the mean amplitude fraction of the next step, [N], for beta windows [N, W].

        Raises:
            ValueError: another number of rows than before.
        """
        states = np.asarray(states, dtype=np.float64)
        policy, rule = self._policy, self._policy.rule
        if self._run is None:
            self._run = RuleRun([rule], len(states), np.ones(len(states)))
            for past in states.T[-1 - int(np.ceil(rule.averaging_s / policy.period_s)) : -1]:
                for _ in range(policy.updates):
                    self._run.remember(past)
        if len(states) != self._run.share.size:
            raise ValueError(f"a rule began with {self._run.share.size} sessions and got {len(states)}")
        newest = states[:, -1]
        given = rule.deliver(np.stack([self._run.update(newest) for _ in range(policy.updates)])) / policy.cdbs_ma
        self.mean_square = np.asarray((given**2).mean(axis=0))
        return np.asarray(given.mean(axis=0))
