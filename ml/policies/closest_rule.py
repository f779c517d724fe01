"""Search for the threshold rule that is closest to a policy on a participant's own sessions, and what is lost by it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ml.policies.policy import Policy, start_sessions
from ml.policies.threshold_rule import (
    AVERAGING_S,
    BLANKING_S,
    RAMP_S,
    STEP_MA,
    UPDATE_S,
    Mode,
    RuleError,
    RuleRun,
    ThresholdPolicy,
    ThresholdRule,
)  # fmt: skip
from ml.progress import Report, part_of, silent
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

QUANTILES: Final = (0.1, 0.25, 0.4, 0.5, 0.6, 0.75, 0.9)
"""Of the participant's beta, at which thresholds are tried first."""
RAMPS_S: Final[dict[Mode, tuple[tuple[float, float], ...]]] = {
    "dual": ((2.0, 2.0), (10.0, 10.0), (60.0, 60.0), (150.0, 300.0)),
    "single": ((0.25, 0.25), (10.0, 10.0)),
}
"""Up and down; the last of `dual` and the first of `single` are the defaults of the device."""
ONSETS_S: Final[dict[Mode, tuple[float, ...]]] = {"dual": (1.2, 4.0, 10.0), "single": (0.2, 4.0, 10.0)}
"""The first is the default, with which the search begins. All are below 30 s, the most that a programmer was seen to offer."""
AVERAGING_STEPS: Final = (1, 3, 6, 10)
"""Durations of averaging, in steps of the study; the first is how the study itself measures beta."""
SHIFT: Final = 0.07
"""Change of a threshold's quantile, and STRETCH the factor of a ramp, that are tried next to the best rules."""
STRETCH: Final = 2.0
BEST: Final = 4
"""Rules near which the search goes on."""
CLOSE: Final = 0.1
"""Largest root mean squared difference, of cDBS, of a rule that replaces a policy: in simulation its promises are kept up to here."""
FINALISTS: Final = 12
"""Rules that are run again with the steps of the device."""
_MOST_ROWS: Final = 12_000
DEFAULT_RAMP_S: Final = (150.0, 300.0)
DEFAULT_RANGE_MA: Final = 0.6
"""Range of amplitudes of the reference: that which patients kept, 0.58 +- 0.19 mA (Busch et al. 2025)."""


@dataclass(frozen=True)
class AmplitudeRange:
    """Amplitudes that a rule may use, mA: the participant's bounds, and the device's step."""

    low_ma: float
    high_ma: float
    step_ma: float = STEP_MA

    @property
    def usable(self) -> tuple[float, float]:
        """Least and most multiple of the step within the bounds.

        Raises:
            RuleError: there is none.
        """
        low = np.ceil(self.low_ma / self.step_ma - 1e-6) * self.step_ma
        high = np.floor(self.high_ma / self.step_ma + 1e-6) * self.step_ma
        if low > high + 1e-9:
            what = f"no amplitude from {self.low_ma:g} to {self.high_ma:g} mA is a multiple of the device's {self.step_ma:g} mA"
            raise RuleError("upper_ma", f"{what}; widen the limits")
        return round(float(low), 6), round(float(high), 6)


@dataclass(frozen=True)
class Closeness:
    """Difference between a rule and a policy over logged beta: what both would have answers, not what would have followed.

    Attributes:
        rms_ma: root mean squared difference.
        mean_ma: of the rule less the policy.
        apart: share of the steps that are more than a twentieth of cDBS apart.
        energy_rule, energy_policy: mean squared fraction.
        steps: that were compared.
        sessions: with a step to compare.
    """

    rms_ma: float
    mean_ma: float
    apart: float
    energy_rule: float
    energy_policy: float
    steps: int
    sessions: int


@dataclass(frozen=True)
class ClosestRule:
    """The closest of the tried rules to a policy."""

    rule: ThresholdRule
    closeness: Closeness
    tried: int


@dataclass(frozen=True)
class _Logged:
    """Sessions side by side.

    Attributes:
        power: newest beta before each step, the last known one where it is missing, [n, T].
        answers: of the policy, fractions [n, T]; NaN where its window is not complete.
    """

    power: Floats
    answers: Floats


def closest_rule(policy: Policy, buffer: ReplayBuffer, cdbs_ma: float, limits: AmplitudeRange, report: Report = silent) -> ClosestRule:
    """Find the rule whose amplitudes on the participant's sessions are closest to a policy's, by their squared difference.

    Thresholds are quantiles of beta. Timers and ramps are those of the tables above and, near the best of these, others. For each the best
    amplitudes follow by least squares. The device averages over at least one step, so that it sees beta as the study does.

    Raises:
        RuleError: no amplitude is allowed. ValueError: beta has no spread, or no session has a complete window.
    """
    low_ma, high_ma = limits.usable
    if not any(np.isfinite(s.states()[:-1]).all(axis=1).any() for s in buffer.sessions):
        raise ValueError("no session has a whole window of beta, so nothing can be compared with the policy")
    logged = _side_by_side(policy, buffer)
    known = np.isfinite(logged.answers)
    target = np.where(known, logged.answers, 0.0) * cdbs_ma
    beta = np.concatenate([s.measured_beta for s in buffer.sessions])
    beta = np.sort(beta[np.isfinite(beta)])
    if beta[0] < 0 or np.unique(np.quantile(beta, QUANTILES)).size < 2:
        raise ValueError("beta has no spread, or is below 0 and so no power: no thresholds can be found for it")
    trial = _Trial(logged, target, known, (low_ma, high_ma), buffer.settings.period_s)
    found = trial.run(_first(beta, buffer.settings.period_s, high_ma, limits.step_ma), part_of(report, 0, 2))
    best = [rule for _, rule in sorted(found, key=lambda f: f[0])[:BEST]]
    found += trial.run(_neighbours(best, beta), part_of(report, 1, 2))
    finalists = [rule for _, rule in sorted(found, key=lambda f: f[0])[:FINALISTS]]
    measured = [(closeness(rule, logged.answers, logged.power, cdbs_ma, buffer.settings.period_s), rule) for rule in finalists]
    closest, rule = min(measured, key=lambda m: m[0].rms_ma)
    return ClosestRule(rule, closest, len(found))


def closeness(rule: ThresholdRule, answers: Floats, power: Floats, cdbs_ma: float, period_s: float) -> Closeness:
    """Compare a rule with what a policy answers, fractions [n, T], on the powers that both saw, [n, T]."""
    running = ThresholdPolicy(rule, cdbs_ma, period_s).begin()
    given, squares = np.empty_like(power), np.empty_like(power)
    for t in range(power.shape[1]):
        given[:, t] = running.act(power[:, t : t + 1])
        squares[:, t] = running.mean_square
    known = np.isfinite(answers)
    apart = (given - answers)[known]
    return Closeness(
        rms_ma=float(np.sqrt(np.mean(apart**2))) * cdbs_ma,
        mean_ma=float(apart.mean()) * cdbs_ma,
        apart=float(np.mean(np.abs(apart) > 0.05)),
        energy_rule=float(squares[known].mean()),
        energy_policy=float(np.mean(answers[known] ** 2)),
        steps=int(known.sum()),
        sessions=int(known.any(axis=1).sum()),
    )


def _side_by_side(policy: Policy, buffer: ReplayBuffer) -> _Logged:
    """Lay sessions side by side; the shorter ones are filled with their last power, where nothing is compared."""
    sessions, window = buffer.sessions, buffer.settings.window
    most = max(s.steps for s in sessions)
    power, answers = np.full((len(sessions), most), np.nan), np.full((len(sessions), most), np.nan)
    for i, s in enumerate(sessions):
        states = s.states()[:-1]
        power[i, : s.steps] = s.padded_beta[window - 1 : -1]
        whole = np.isfinite(states).all(axis=1)
        if whole.any():
            answers[i, np.flatnonzero(whole)] = start_sessions(policy).act(states[whole])
    for t in range(1, most):
        power[:, t] = np.where(np.isnan(power[:, t]), power[:, t - 1], power[:, t])
    first = np.nanmean(power)
    return _Logged(np.where(np.isnan(power), first, power), answers)


def _first(beta: Floats, period_s: float, high_ma: float, step_ma: float) -> list[ThresholdRule]:
    """List the rules that are tried first, without their limits, which do not change the way between them."""
    levels = np.unique(np.quantile(beta, QUANTILES))
    thresholds: dict[Mode, list[tuple[float, float]]] = {
        "dual": [(float(a), float(b)) for a, b in combinations(levels, 2)],
        "single": [(float(a), float(a)) for a in levels],
    }
    return [
        ThresholdRule(
            mode=mode, lower_threshold=lower, upper_threshold=upper, lower_ma=high_ma, upper_ma=high_ma, ramp_up_s=up, ramp_down_s=down,
            onset_s=ONSETS_S[mode][0], termination_s=ONSETS_S[mode][0], averaging_s=steps * period_s, blanking_s=BLANKING_S[mode],
            step_ma=step_ma,
        )
        for mode in UPDATE_S
        for steps in AVERAGING_STEPS if steps * period_s <= AVERAGING_S[1]
        for (lower, upper), (up, down) in product(thresholds[mode], RAMPS_S[mode])
    ]  # fmt: skip


def _neighbours(rules: Sequence[ThresholdRule], beta: Floats) -> list[ThresholdRule]:
    """List the neighbours of rules: thresholds shift, each ramp shorter or longer, other timers."""
    found: dict[ThresholdRule, None] = {}

    def shift(threshold: float) -> list[float]:
        share = float(np.searchsorted(beta, threshold)) / beta.size
        return [float(np.quantile(beta, np.clip(share + d, 0.01, 0.99))) for d in (-SHIFT, 0.0, SHIFT)]

    def stretch(ramp_s: float) -> list[float]:
        return [float(np.clip(ramp_s * f, *RAMP_S)) for f in (1 / STRETCH, 1.0, STRETCH)]

    for rule in rules:
        lower, upper = shift(rule.lower_threshold), shift(rule.upper_threshold)
        pairs = [(t, t) for t in upper] if rule.mode == "single" else [(a, b) for a in lower for b in upper if a < b]
        for (low, high), onset in product(pairs, ONSETS_S[rule.mode]):
            for up, down in product(stretch(rule.ramp_up_s), stretch(rule.ramp_down_s)):
                near = replace(rule, lower_threshold=low, upper_threshold=high, ramp_up_s=up, ramp_down_s=down)
                found[replace(near, onset_s=onset, termination_s=onset)] = None
    return list(found)


@dataclass(frozen=True)
class _Trial:
    """Sessions on which rules are tried against a policy.

    Attributes:
        logged: sessions. target: what the policy answers, mA [n, T]. known: where it did. limits: least and most, mA. period_s: of a step.
    """

    logged: _Logged
    target: Floats
    known: NDArray[np.bool_]
    limits: tuple[float, float]
    period_s: float

    def run(self, rules: Sequence[ThresholdRule], report: Report) -> list[tuple[float, ThresholdRule]]:
        """Try rules, each with its best limits: their squared differences and the rules, in any order."""
        block = max(1, _MOST_ROWS // len(self.logged.power))
        groups: dict[tuple[Mode, float], list[ThresholdRule]] = {}
        for rule in rules:
            groups.setdefault((rule.mode, rule.averaging_s), []).append(rule)
        parts = [g[i : i + block] for g in groups.values() for i in range(0, len(g), block)]
        found: list[tuple[float, ThresholdRule]] = []
        for done, part in enumerate(parts):
            found += [self._fit(rule, share) for rule, share in zip(part, self._shares(part), strict=True)]
            report((done + 1) / len(parts), "trying rules")
        return found

    def _shares(self, rules: Sequence[ThresholdRule]) -> Floats:
        """Run rules of one mode over all sessions; mean way from the lower to the upper limit of every step, [R, n, T]."""
        n, steps = self.logged.power.shape
        run = RuleRun([r for r in rules for _ in range(n)], len(rules) * n, np.ones(len(rules) * n))
        updates = round(self.period_s / rules[0].update_s)
        found = np.empty((steps, len(rules) * n))
        for t in range(steps):
            now = np.tile(self.logged.power[:, t], len(rules))
            found[t] = sum(run.update(now) for _ in range(updates)) / updates
        return np.moveaxis(found.reshape(steps, len(rules), n), 0, -1)

    def _fit(self, rule: ThresholdRule, share: Floats) -> tuple[float, ThresholdRule]:
        """Give a rule the limits of least squared difference, and return that difference, mA^2 summed."""
        x, y = share[self.known], self.target[self.known]
        low, high = self.limits
        levels = low + rule.step_ma * np.arange(round((high - low) / rule.step_ma) + 1)
        lower, way = levels[:, None], np.maximum(levels[None, :] - levels[:, None], 0.0)  # below the diagonal: as with equal limits
        squares = (
            x.size * lower**2 + 2 * lower * way * x.sum() + way**2 * (x @ x) - 2 * lower * y.sum() - 2 * way * (x @ y) + y @ y
        )  # of lower + way x - y
        i, j = np.unravel_index(int(np.argmin(squares)), squares.shape)
        lower_ma, upper_ma = (round(float(levels[k]), 6) for k in (i, max(i, j)))
        return float(squares[i, j]), replace(rule, lower_ma=lower_ma, upper_ma=upper_ma)


def usual_rule(buffer: ReplayBuffer, limits: AmplitudeRange, mode: Mode = "dual") -> ThresholdRule:
    """Build the rule that clinics begin with: thresholds at quartiles of beta, the device's default timers, 0.6 mA below cDBS.

    A single threshold is at three quarters of the way between the quartiles. Chronic use ends above cDBS at times; here nothing is.

    Raises:
        RuleError: no amplitude is allowed. ValueError: beta has no spread between its quartiles.
    """
    low_ma, high_ma = limits.usable
    beta = np.concatenate([session.measured_beta for session in buffer.sessions])
    low, high = (float(q) for q in np.nanquantile(beta, [0.25, 0.75]))
    if not low < high:
        raise ValueError(f"beta has no spread between its quartiles (both {low:.4g}): no thresholds can be found for it")
    if mode == "single":
        low = high = low + 0.75 * (high - low)
    up, down = DEFAULT_RAMP_S if mode == "dual" else RAMPS_S["single"][0]
    onset = ONSETS_S[mode][0]
    return ThresholdRule(
        mode=mode, lower_threshold=low, upper_threshold=high, lower_ma=round(max(low_ma, high_ma - DEFAULT_RANGE_MA), 6), upper_ma=high_ma,
        ramp_up_s=up, ramp_down_s=down, onset_s=onset, termination_s=onset, averaging_s=buffer.settings.period_s,
        blanking_s=BLANKING_S[mode], step_ma=limits.step_ma,
    )  # fmt: skip
