"""The safety envelope: what stands between a network's wish and the stimulator.

It knows nothing of how the fraction was made. Every period it decides on one amplitude in milliamperes, and says why:

* amplitudes lie within the clinician's limits;
* between two periods the amplitude moves by no more than the ramp limit allows;
* beta that is missing, not a number, too old, or not yet a whole window, and a policy that fails or answers outside [0, 1], give the cDBS
  amplitude in the very period in which that is found. This return to the programmed therapy is *not* ramped unless
  `fallback_ramp_ma_per_s` says so: a ramp would leave the participant under-treated for some periods on a signal nobody trusts.

`step` is a pure function of what it is given: the same inputs give the same decision, and a log of them can be replayed.
"""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from ml.rl.onnx_policy import RANGE_TOLERANCE
from ml.rl.policy import Policy

SPACING_TOLERANCE = 0.5
"""Two beta amplitudes of a window may lie this share of a period closer or farther than one period; beyond, the window has a gap."""
_EPSILON_MA = 1e-9


class Reason:
    """Why a decision differs from the policy's wish; kept in the decision log."""

    NO_BETA = "no_beta"  # no beta amplitude has come yet
    STALE_BETA = "stale_beta"  # the newest beta amplitude is too old
    INVALID_BETA = "invalid_beta"  # a beta amplitude of the window is not a finite number
    WINDOW_INCOMPLETE = "window_incomplete"  # fewer than W beta amplitudes
    WINDOW_GAP = "window_gap"  # beta amplitudes of the window are not one period apart
    LATE_SAMPLE = "late_sample"  # a beta amplitude not newer than the last one, or from the future, was left out
    POLICY_FAILED = "policy_failed"  # the policy raised an error
    POLICY_OUTPUT = "policy_output"  # the policy's answer is no fraction in [0, 1]
    MINIMUM = "minimum"  # raised to the clinician's minimum
    MAXIMUM = "maximum"  # lowered to the clinician's maximum
    RAMP = "ramp"  # held back by the ramp limit


@dataclass(frozen=True, kw_only=True)
class EnvelopeLimits:
    """The clinician's limits for one participant.

    Attributes:
        min_ma, max_ma: lowest and highest amplitude, mA.
        cdbs_ma: cDBS amplitude, mA: what fraction 1 means, and the fall-back. Lies within the limits.
        ramp_ma_per_s: fastest change of the amplitude, mA per second.
        window: W, beta amplitudes per decision.
        period_s: m, seconds per decision.
        max_beta_age_s: age at which a beta amplitude is stale; None means one period.
        fallback_ramp_ma_per_s: fastest change on the way back to the cDBS amplitude; None means at once.

    Raises:
        ValueError: a value outside its range; the message names it.
    """

    min_ma: float
    max_ma: float
    cdbs_ma: float
    ramp_ma_per_s: float
    window: int = 10
    period_s: float = 2.0
    max_beta_age_s: float | None = None
    fallback_ramp_ma_per_s: float | None = None

    def __post_init__(self) -> None:
        for name, value in asdict(self).items():
            if value is not None and not math.isfinite(value):
                raise ValueError(f"{name} must be a finite number, not {value}")
        if not 0 <= self.min_ma <= self.max_ma:
            raise ValueError(f"the amplitude limits must rise from 0 or more, not {self.min_ma} to {self.max_ma} mA")
        if not self.min_ma <= self.cdbs_ma <= self.max_ma or self.cdbs_ma <= 0:
            raise ValueError(
                f"the cDBS amplitude {self.cdbs_ma} mA must lie within the limits, {self.min_ma} to {self.max_ma} mA, and above 0"
            )
        for name in ("ramp_ma_per_s", "period_s", "max_beta_age_s", "fallback_ramp_ma_per_s"):
            value = getattr(self, name)
            if value is not None and value <= 0:
                raise ValueError(f"{name} must be positive, not {value}")
        if self.window < 1:
            raise ValueError(f"window must be at least 1 step, not {self.window}")


@dataclass(frozen=True)
class BetaSample:
    """One beta amplitude (participant's unit; NaN where the device gave none) and the time of its window's end, seconds."""

    t_s: float
    beta: float


@dataclass(frozen=True)
class EnvelopeState:
    """What the next decision depends on: the amplitude in force (mA) and the newest W beta amplitudes, oldest first."""

    amplitude_ma: float
    samples: tuple[BetaSample, ...] = ()


@dataclass(frozen=True)
class Decision:
    """One entry of the decision log.

    Attributes:
        t_s: time of the decision, seconds.
        amplitude_ma: amplitude to deliver, mA.
        fallback: True when the cDBS amplitude stands in for the policy.
        reasons: every `Reason` that applied; empty when the policy's wish was delivered as it is.
        fraction: the policy's answer as it came; None where it was not asked or failed.
        requested_ma: the wish in mA, before the limits; None where there was none.
        beta, beta_age_s: newest beta amplitude and its age, seconds; None before the first.
        detail: the policy's error text, where it failed.
    """

    t_s: float
    amplitude_ma: float
    fallback: bool
    reasons: tuple[str, ...]
    fraction: float | None = None
    requested_ma: float | None = None
    beta: float | None = None
    beta_age_s: float | None = None
    detail: str = ""

    def to_json(self) -> dict[str, Any]:
        """The entry for a log; numbers that are not finite become None, as JSON has none."""
        values = asdict(self) | {"reasons": list(self.reasons)}
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()}


def initial_state(limits: EnvelopeLimits) -> EnvelopeState:
    """The start of a session: cDBS in force, no beta yet."""
    return EnvelopeState(limits.cdbs_ma)


def step(
    limits: EnvelopeLimits, state: EnvelopeState, now_s: float, sample: BetaSample | None, policy: Policy
) -> tuple[EnvelopeState, Decision]:
    """Decide on the amplitude of the period that starts now.

    Args:
        limits: the clinician's limits.
        state: from the last decision, or `initial_state`.
        now_s: time of this decision, seconds, on the clock of the samples.
        sample: the beta amplitude that came since the last decision; None when none came.
        policy: asked only when the window is whole and fresh.

    Returns:
        The state for the next decision, and the log entry.
    """
    samples, late = _admit(limits, state.samples, sample, now_s)
    newest = samples[-1] if samples else None
    seen: dict[str, Any] = {"beta": newest.beta, "beta_age_s": now_s - newest.t_s} if newest else {}
    trouble = _window_trouble(limits, samples, now_s)
    if not trouble:
        fraction, trouble, detail = _ask(policy, samples)
        seen |= {"fraction": fraction, "detail": detail}
    if trouble:
        amplitude, ramped = _fall_back(limits, state.amplitude_ma)
        decision = Decision(now_s, amplitude, True, (*late, *trouble, *ramped), **seen)
    else:
        requested = min(max(float(seen["fraction"]), 0.0), 1.0) * limits.cdbs_ma
        amplitude, bounded = _bounded(limits, state.amplitude_ma, requested)
        decision = Decision(now_s, amplitude, False, (*late, *bounded), requested_ma=requested, **seen)
    return EnvelopeState(amplitude, samples), decision


def _admit(
    limits: EnvelopeLimits, samples: tuple[BetaSample, ...], sample: BetaSample | None, now_s: float
) -> tuple[tuple[BetaSample, ...], tuple[str, ...]]:
    """The window with the new sample in it; one that is out of order or from the future is left out and said."""
    if sample is None:
        return samples, ()
    in_order = not samples or sample.t_s > samples[-1].t_s
    if not (in_order and sample.t_s <= now_s):
        return samples, (Reason.LATE_SAMPLE,)
    return (*samples, sample)[-limits.window :], ()


def _window_trouble(limits: EnvelopeLimits, samples: tuple[BetaSample, ...], now_s: float) -> tuple[str, ...]:
    if not samples:
        return (Reason.NO_BETA,)
    trouble = []
    max_age = limits.period_s if limits.max_beta_age_s is None else limits.max_beta_age_s
    if not now_s - samples[-1].t_s <= max_age + 1e-9:  # so written that a clock that is not a number counts as stale
        trouble.append(Reason.STALE_BETA)
    if not all(math.isfinite(s.beta) for s in samples):
        trouble.append(Reason.INVALID_BETA)
    if len(samples) < limits.window:
        trouble.append(Reason.WINDOW_INCOMPLETE)
    spacing = np.diff([s.t_s for s in samples])
    if np.any(np.abs(spacing - limits.period_s) > SPACING_TOLERANCE * limits.period_s):
        trouble.append(Reason.WINDOW_GAP)
    return tuple(trouble)


def _ask(policy: Policy, samples: tuple[BetaSample, ...]) -> tuple[float | None, tuple[str, ...], str]:
    """The policy's fraction; or why it cannot be used."""
    try:
        answer = np.asarray(policy.act(np.array([[s.beta for s in samples]])), dtype=np.float64)
    except Exception as error:  # whatever a policy does, the participant is stimulated: the fault goes into the log
        return None, (Reason.POLICY_FAILED,), f"{type(error).__name__}: {error}"
    if answer.shape != (1,):
        return None, (Reason.POLICY_OUTPUT,), f"answer of shape {list(answer.shape)} instead of [1]"
    fraction = float(answer[0])
    if not -RANGE_TOLERANCE <= fraction <= 1 + RANGE_TOLERANCE:
        return fraction, (Reason.POLICY_OUTPUT,), f"answer {fraction} outside [0, 1]"
    return fraction, (), ""


def _fall_back(limits: EnvelopeLimits, previous_ma: float) -> tuple[float, tuple[str, ...]]:
    if limits.fallback_ramp_ma_per_s is None:
        return limits.cdbs_ma, ()
    previous_ma = min(max(previous_ma, limits.min_ma), limits.max_ma)
    amplitude = _towards(previous_ma, limits.cdbs_ma, limits.fallback_ramp_ma_per_s * limits.period_s)
    return amplitude, (Reason.RAMP,) if abs(amplitude - limits.cdbs_ma) > _EPSILON_MA else ()


def _bounded(limits: EnvelopeLimits, previous_ma: float, requested_ma: float) -> tuple[float, tuple[str, ...]]:
    """Clinician's limits first, then the ramp, from the amplitude in force or the limit nearest to it: the result lies within the
    limits."""
    reasons = []
    previous_ma = min(max(previous_ma, limits.min_ma), limits.max_ma)
    wanted = min(max(requested_ma, limits.min_ma), limits.max_ma)
    if wanted > requested_ma:
        reasons.append(Reason.MINIMUM)
    elif wanted < requested_ma:
        reasons.append(Reason.MAXIMUM)
    amplitude = _towards(previous_ma, wanted, limits.ramp_ma_per_s * limits.period_s)
    if abs(amplitude - wanted) > _EPSILON_MA:
        reasons.append(Reason.RAMP)
    return amplitude, tuple(reasons)


def _towards(start: float, goal: float, most: float) -> float:
    if abs(goal - start) <= most:
        return goal
    return start + math.copysign(most, goal - start)
