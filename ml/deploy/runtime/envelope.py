"""The safety envelope between a network's request and the stimulator. `ml/deploy/c_envelope.py` has the same rules in C.

It knows nothing of how the fraction was made. Every period it decides on one amplitude in milliamperes, and says why:

* amplitudes lie within the clinician's limits, always;
* from one decision to the next the amplitude moves by no more than the ramp limit times the time between them. However late a decision
  comes, it moves by no more than the ramp limit times one period;
* untrusted beta, or a network that fails or answers outside [0, 1], gives the cDBS amplitude in the very decision in which that is found.
  Untrusted is beta that has not come when it was due, is not a number, negative, or of another unit or source. So is a window that is not
  whole. Where the limits define them, so is beta that is saturated, frozen or on a level that was never logged. This return
  to the programmed therapy is *not* ramped: a ramp would leave the participant under-treated for some periods on an untrusted signal. It is
  the one exception to the ramp limit;
* a window is whole with W amplitudes one period apart. As many of them may be imputed as learning admits (`most_imputed`), never the
  newest. Only what was lost is imputed: an amplitude that did not come, or was no number. What came and is wrong starts a new window;
* the network is asked again once the window is whole and its newest amplitude is measured. From cDBS the amplitude moves at the ramp
  limit.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any, NamedTuple

SPACING_TOLERANCE = 0.5
"""Two beta amplitudes may lie this share of a period closer or farther than one period; beyond, the window has a gap."""
STALE_AFTER = 0.9
"""Share of a period after which a beta amplitude is stale. The next one is due then, and a decision in time finds that it has not come. A
tenth of a period is left for the jitter of the decisions."""
RANGE_TOLERANCE = 1e-4
"""A fraction this far outside [0, 1] is rounding and is cut; farther outside it is a fault."""
LARGEST_BETA = 3.4028234663852886e38
"""The largest float32: every runtime takes beta amplitudes as such."""
_TIME_EPSILON_S = 1e-9
FLAG_MA = 1e-4
"""A limit that takes off less than this many mA is rounding and is not named among the reasons."""


class Reason:
    """Reason why a decision differs from the network's request: bits of `Decision.reasons`, the same in the C header."""

    NO_BETA = 1  # no beta amplitude has come yet
    STALE_BETA = 2  # the newest beta amplitude is too old
    INVALID_BETA = 4  # the beta amplitude is not a number, negative or infinite
    WRONG_SIGNAL = 8  # the beta amplitude is of another unit or source than the network was trained on
    WINDOW_INCOMPLETE = 16  # fewer than W beta amplitudes since the start or the last fault, or too many imputed ones among them
    WINDOW_GAP = 32  # the beta amplitude is not one period after the one before, and what is between may not be imputed
    LATE_SAMPLE = 64  # a beta amplitude not newer than the last one, or from the future, was ignored
    POLICY_FAILED = 128  # the network raised an error
    POLICY_OUTPUT = 256  # the network's answer is no fraction in [0, 1]
    MINIMUM = 512  # raised to the clinician's minimum
    MAXIMUM = 1024  # lowered to the clinician's maximum
    RAMP = 2048  # limited by the ramp limit
    SATURATED_BETA = 4096  # the beta amplitude is above what any recording of the participant makes plausible
    FROZEN_BETA = 8192  # the same beta amplitude came again and again
    BETA_LEVEL = 16384  # the mean of the window is far from every level that was logged: another unit, a loose contact
    LINK = 32768  # the input repeats, skips or restarts its numbers or its clock, or was lost; found by the loop, not by the envelope
    IMPUTED_BETA = 65536  # the network's window has imputed beta amplitudes among the older ones


_NOTES = Reason.LATE_SAMPLE | Reason.WINDOW_GAP  # no trouble in themselves: the window that they leave behind is judged
REASON_NAMES = {value: name.lower() for name, value in vars(Reason).items() if name.isupper()}
OF_THE_CONTROLLER = Reason.POLICY_FAILED | Reason.POLICY_OUTPUT | Reason.MINIMUM | Reason.MAXIMUM | Reason.RAMP
"""Reasons that cDBS, one amplitude within its limits, never gives: they reveal a blinded session's controller."""


def reason_names(reasons: int) -> tuple[str, ...]:
    """Name the bits, lowest first."""
    return tuple(name for bit, name in REASON_NAMES.items() if reasons & bit)


@dataclass(frozen=True, kw_only=True)
class EnvelopeLimits:
    """The clinician's limits for one participant.

    Attributes:
        min_ma, max_ma: lowest and highest amplitude, mA.
        cdbs_ma: cDBS amplitude, mA: what fraction 1 means, and the fall-back. It is within the limits.
        ramp_ma_per_s: fastest change of the amplitude, mA per second.
        window: W, beta amplitudes per decision.
        period_s: m, seconds per decision.
        max_beta_age_s: age above which a beta amplitude is stale, less than one period; None means `STALE_AFTER` of a period.
        beta_max: beta amplitude above which the input counts as saturated; None where it is unknown.
        level_low, level_high: range of the mean of a window, in the unit of the beta amplitudes; None where it is unknown.
        frozen_after: so many equal beta amplitudes in a row count as frozen, 2 or more; None leaves them uncounted.
        most_imputed: lost beta amplitudes that a window may hold as imputed ones, fewer than W; as the policy's training had it.
        carried_over: weight, 0 to 1, of the line between both measured neighbours in an imputed value; the rest is the window's mean.

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
    beta_max: float | None = None
    level_low: float | None = None
    level_high: float | None = None
    frozen_after: int | None = None
    most_imputed: int = 0
    carried_over: float = 1.0

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
        for name in ("ramp_ma_per_s", "period_s", "max_beta_age_s", "beta_max"):
            value = getattr(self, name)
            if value is not None and value <= 0:
                raise ValueError(f"{name} must be positive, not {value}")
        if self.max_beta_age_s is not None and self.max_beta_age_s >= self.period_s:
            raise ValueError(f"beta is stale before one period ({self.period_s} s) has passed, not after {self.max_beta_age_s} s")
        if self.window < 1:
            raise ValueError(f"window must be at least 1 step, not {self.window}")
        if (self.level_low is None) != (self.level_high is None) or not 0 <= (self.level_low or 0.0) <= (self.level_high or math.inf):
            raise ValueError(f"the level of beta needs a range that rises from 0 or more, not {self.level_low} to {self.level_high}")
        if self.frozen_after is not None and self.frozen_after < 2:
            raise ValueError(f"beta is frozen after 2 equal amplitudes at the earliest, not after {self.frozen_after}")
        if not 0 <= self.most_imputed < self.window or not 0 <= self.carried_over <= 1:
            raise ValueError(
                f"{self.most_imputed} imputed beta amplitudes of {self.window}, carried over by {self.carried_over}, are no rule"
            )

    @property
    def stale_after_s(self) -> float:
        """Age beyond which a beta amplitude is stale, seconds."""
        return STALE_AFTER * self.period_s if self.max_beta_age_s is None else self.max_beta_age_s


class Signal(NamedTuple):
    """Unit of a beta amplitude, and how it was made."""

    unit: str
    source: str


class BetaSample(NamedTuple):
    """One beta amplitude (NaN where the device gave none), the time of its window's end in seconds, and what it says it is."""

    t_s: float
    beta: float
    signal: Signal


class Decision(NamedTuple):
    """One entry of the decision log.

    Attributes:
        t_s: time of the decision, seconds.
        amplitude_ma: amplitude to deliver, mA.
        fallback: True when the cDBS amplitude replaces the network's.
        reasons: bits of `Reason`; 0 when the network's wish was delivered as it is.
        fraction: the network's answer as it came; None where it was not asked or failed.
        requested_ma: the wish in mA, before the limits; None where there was none.
        beta_age_s: age of the newest beta amplitude; None before the first.
        valid: beta amplitudes in the window, 0 to W; `Reason.IMPUTED_BETA` says whether any is imputed.
        detail: the network's error text, where it failed.
    """

    t_s: float
    amplitude_ma: float
    fallback: bool
    reasons: int
    fraction: float | None
    requested_ma: float | None
    beta_age_s: float | None
    valid: int
    detail: str = ""

    def to_json(self) -> dict[str, Any]:
        """Convert the decision to an entry for a log; numbers that are not finite become None, as JSON has none."""
        values = self._asdict() | {"reasons": list(reason_names(self.reasons))}
        return {k: None if isinstance(v, float) and not math.isfinite(v) else v for k, v in values.items()}


class Envelope:
    """Counts valid beta amplitudes, and turns a network's fraction into an amplitude that the clinician allows.

    Args:
        limits: the clinician's.
        signal: unit and source that the network was trained on.

    A session starts with cDBS in force and no beta. The same inputs in the same order always give the same decisions.
    """

    __slots__ = (
        "_age_s", "_beta_max", "_closest_s", "_equal", "_farthest_s", "_frozen_after", "_imputed", "_last_beta", "_last_decision_s",
        "_last_sample_s", "_last_valid_s", "_level", "_streak", "amplitude_ma", "limits", "signal",
    )  # fmt: skip

    def __init__(self, limits: EnvelopeLimits, signal: Signal) -> None:
        self.limits = limits
        self.signal = signal
        self.amplitude_ma = limits.cdbs_ma
        self._age_s = limits.stale_after_s + _TIME_EPSILON_S
        self._closest_s = (1 - SPACING_TOLERANCE) * limits.period_s - _TIME_EPSILON_S
        self._farthest_s = (1 + SPACING_TOLERANCE) * limits.period_s + _TIME_EPSILON_S
        self._last_sample_s: float | None = None
        self._last_decision_s: float | None = None
        self._last_valid_s = 0.0
        self._streak = self._imputed = 0
        self._beta_max = math.inf if limits.beta_max is None else _float32(limits.beta_max)
        self._frozen_after = math.inf if limits.frozen_after is None else limits.frozen_after
        self._last_beta, self._equal, self._level = -1.0, 0, 0.0

    def forget(self) -> None:
        """Trust nothing that came so far, as after a break of the link: cDBS until a whole new window has come."""
        self._last_sample_s, self._streak, self._imputed, self._equal = None, 0, 0, 0

    def begin(self, now_s: float) -> None:
        """Start a decision. When the clock has run back, what came before is forgotten, so that a corrected clock does not lock the network
        out."""
        if self._last_sample_s is not None and now_s < self._last_sample_s - _TIME_EPSILON_S:
            self._last_sample_s, self._streak, self._imputed = None, 0, 0
        if self._last_decision_s is not None and now_s < self._last_decision_s:
            self._last_decision_s = now_s

    def admit(self, now_s: float, sample: BetaSample) -> tuple[int, tuple[float, ...]]:
        """Judge a new beta amplitude. Returns the reasons against it, and the amplitudes that enter the network's window.

        These are imputed ones for what was lost before it, and itself; none where it may not be used."""
        t_s, beta, signal = sample
        last = self._last_sample_s
        if not (t_s <= now_s + _TIME_EPSILON_S and (last is None or t_s > last)) or t_s == -math.inf:  # NaN is never in order
            return Reason.LATE_SAMPLE, ()
        self._last_sample_s = t_s
        reasons = 0
        if signal is not self.signal and signal != self.signal:
            reasons = Reason.WRONG_SIGNAL
        before = self._last_beta
        if math.isnan(beta) and not reasons and self.limits.most_imputed:
            return Reason.INVALID_BETA, ()  # lost like one that did not come: the next one shows whether it may be imputed
        if not 0.0 <= beta <= LARGEST_BETA:
            reasons |= Reason.INVALID_BETA
            self._equal = 0
        else:
            reasons |= self._implausible(beta)
        if reasons:
            self._streak = self._imputed = 0
            return reasons, ()
        lost = self._lost_before(t_s)
        if lost is None:
            self._streak = self._imputed = 0
            return Reason.WINDOW_GAP, self._take(t_s, (), beta)
        level, weight = self._level, self.limits.carried_over
        line = [before + (beta - before) * (i + 1) / (lost + 1) for i in range(lost)]
        return 0, self._take(t_s, tuple(level + weight * (value - level) for value in line), beta)

    def _lost_before(self, t_s: float) -> int | None:
        """Count the amplitudes lost between the newest valid one and one at `t_s`; None where the window has to start again."""
        if not self._streak:
            return 0
        spacing = t_s - self._last_valid_s
        if spacing <= self._farthest_s:
            return 0 if spacing >= self._closest_s else None
        periods = (spacing - _TIME_EPSILON_S) / self.limits.period_s - (1 + SPACING_TOLERANCE)
        return math.ceil(periods) if periods <= self.limits.most_imputed else None

    def _take(self, t_s: float, lost_ones: tuple[float, ...], beta: float) -> tuple[float, ...]:
        """Move the window on by imputed amplitudes and a measured one. Returns all of them."""
        values = (*lost_ones, beta)
        whole = (1 << self.limits.window) - 1
        for at, value in enumerate(values):
            self._imputed = (self._imputed << 1 | (at < len(lost_ones))) & whole
            self._streak = min(self._streak + 1, self.limits.window)
            self._level = value if self._streak == 1 else self._level + (value - self._level) / self._streak
        self._last_valid_s = t_s
        return values

    def _implausible(self, beta: float) -> int:
        """Detect a beta amplitude that is saturated, or one of a row of equal ones; as float32, which is what every runtime compares."""
        beta = _float32(beta)
        self._equal = self._equal + 1 if beta == self._last_beta and self._equal else 1
        self._last_beta = beta
        return (Reason.SATURATED_BETA if beta > self._beta_max else 0) | (Reason.FROZEN_BETA if self._equal >= self._frozen_after else 0)

    def decide(self, now_s: float, reasons: int, ask: Callable[[], float]) -> Decision:
        """Decide on the amplitude of the period that starts now.

        Args:
            now_s: time of this decision, seconds, on the clock of the samples.
            reasons: from `admit`, 0 where no beta amplitude came.
            ask: the network's fraction for its window; called only when the window is whole and fresh.
        """
        limits = self.limits
        last_s = self._last_sample_s
        age = None if last_s is None else now_s - last_s
        trouble = reasons & ~_NOTES
        if age is None:
            trouble |= Reason.NO_BETA
        elif not age <= self._age_s:  # so written that a clock that is not a number counts as stale
            trouble |= Reason.STALE_BETA
        imputed = self._imputed.bit_count()
        if self._streak < limits.window or imputed > limits.most_imputed:
            trouble |= Reason.WINDOW_INCOMPLETE
        elif limits.level_high is not None and not (limits.level_low or 0.0) <= self._level <= limits.level_high:
            trouble |= Reason.BETA_LEVEL
        fraction: float | None = None
        detail = ""
        if not trouble:
            fraction, trouble, detail = _ask(ask)
        most = self._most_ma(now_s)
        reasons |= trouble
        if trouble:
            self.amplitude_ma = limits.cdbs_ma
            return Decision(now_s, limits.cdbs_ma, True, reasons, fraction, None, age, self._streak, detail)
        reasons |= Reason.IMPUTED_BETA if imputed else 0
        requested = min(max(fraction or 0.0, 0.0), 1.0) * limits.cdbs_ma
        wanted = min(max(requested, limits.min_ma), limits.max_ma)
        if wanted > requested + FLAG_MA:
            reasons |= Reason.MINIMUM
        elif wanted < requested - FLAG_MA:
            reasons |= Reason.MAXIMUM
        before = self.amplitude_ma
        amplitude = min(max(wanted, before - most), before + most)
        amplitude = min(max(amplitude, limits.min_ma), limits.max_ma)
        if abs(amplitude - wanted) > FLAG_MA:
            reasons |= Reason.RAMP
        self.amplitude_ma = amplitude
        return Decision(now_s, amplitude, False, reasons, fraction, requested, age, self._streak)

    def _most_ma(self, now_s: float) -> float:
        """Compute the largest change that the ramp limit allows at this decision, mA."""
        period = self.limits.period_s
        last = self._last_decision_s
        elapsed = period if last is None else now_s - last
        if not elapsed > 0:  # a clock that has stopped, has run back or is not a number
            return 0.0
        self._last_decision_s = now_s
        return self.limits.ramp_ma_per_s * min(elapsed, period)


def _float32(value: float) -> float:
    return float(struct.unpack("<f", struct.pack("<f", value))[0])


def _ask(ask: Callable[[], float]) -> tuple[float | None, int, str]:
    """Ask the network for its fraction; or return why it cannot be used."""
    try:
        fraction = float(ask())
    except Exception as error:  # whatever a network does, the participant is stimulated: the fault goes into the log
        return None, Reason.POLICY_FAILED, f"{type(error).__name__}: {error}"
    if not -RANGE_TOLERANCE <= fraction <= 1 + RANGE_TOLERANCE:
        return fraction, Reason.POLICY_OUTPUT, f"answer {fraction} outside [0, 1]"
    return fraction, 0, ""
