"""Verdict on a candidate: worth a test, a test with care, the same as cDBS, likely worse, unsafe, or open.

It is a pure function of posterior draws and of what is known besides. Draws are aligned between the policy and cDBS, so that a common error
of the posterior cancels. What is known more surely comes first: hazards, what the policy does by itself, and then chances. A chance is a
share of draws, calibrated on virtual patients (`calibrate`). Whether the data can order policies is a reason among the others: it may hide
an order, never a verdict.

The verdict asks for non-inferiority of the outcomes and for less energy, because that is what a test is for. Superiority is for
conclusions, which rest on visits and not on estimates.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from ml.ope.estimate import Estimate
from ml.ope.flags import Flag
from ml.outcomes import PREDICTED
from ml.qoc import Margins

Floats = NDArray[np.float64]
Code = Literal["test", "test_with_care", "same_as_cdbs", "undecided", "likely_worse", "unsafe", "cannot_tell"]

NEARLY_OFF = 0.2
"""Amplitudes below this fraction of the cDBS amplitude are nearly off."""

SAME_AMPLITUDE = 0.05
"""A policy whose amplitude is this close to that of cDBS on average (0.15 mA at 3 mA) does what cDBS does."""

FEWEST_DRAWS = 50
"""Fewer draws cannot distinguish a probability of 0.8 from one of 0.9."""

HAZARDS = frozenset({"adverse_event", "stopped", "nearly_off", "beyond_margin"})
"""Codes of reasons for which a policy is not to be run without a clinician's word, whatever the verdict."""

SETTLED_BY_SESSIONS = frozenset({"undecided", "few_near_sessions", "few_near_visits"})
"""Deciding reasons that more sessions near a policy may settle; whether they would is simulated."""

HARM = 2.0
"""An outcome that is worse than under cDBS by more than this many margins is harm."""

CALIBRATION: tuple[tuple[float, float], ...] = (
    (0.0, 0.01),
    (0.03, 0.1),
    (0.11, 0.19),
    (0.23, 0.33),
    (0.38, 0.48),
    (0.51, 0.69),
    (0.64, 0.8),
    (0.74, 0.86),
    (0.83, 0.92),
    (0.9, 0.96),
    (1.0, 0.99),
)
"""Share of draws in which all outcomes are within their margins, and the share of candidates of which that was true. Linear between.
Measured on the 720 candidates of part A of the second population (`python benchmarks/answer.py --calibrate`)."""

RELIABILITY: tuple[tuple[int, float, float], ...] = (
    (131, 0.03, 0.08),
    (79, 0.16, 0.27),
    (73, 0.38, 0.63),
    (40, 0.58, 0.70),
    (47, 0.74, 0.89),
    (80, 0.86, 0.85),
    (270, 0.96, 0.99),
)
"""Of part B, on which nothing was chosen: candidates, calibrated probability that was stated on average, share of which it was true
(`python benchmarks/answer.py --part B`)."""


@dataclass(frozen=True)
class Levels:
    """Certainty that a verdict needs; the defaults are those of the study's settings.

    Attributes:
        test_within: least probability that all outcomes are within their margins for a test; with so much of the contrary it is likely
            worse.
        test_saves: least probability of less energy than cDBS for a test.
        unsafe_beyond: probability of harm, an outcome beyond `HARM` margins, from which a policy is unsafe.
        nearly_off_share: share of steps below `NEARLY_OFF` of cDBS above which a policy is unsafe.

    Raises:
        ValueError: a level that is no probability, or none that could ever be reached.
    """

    test_within: float = 0.8
    test_saves: float = 0.9
    unsafe_beyond: float = 0.9
    nearly_off_share: float = 0.2

    def __post_init__(self) -> None:
        if not (0 < self.test_within < 1 and 0 < self.test_saves < 1 and 0 < self.unsafe_beyond < 1 and 0 <= self.nearly_off_share < 1):
            raise ValueError(f"levels of verdicts must be probabilities between 0 and 1: {self}")


@dataclass(frozen=True)
class Verdict:
    """Verdict on one candidate.

    Attributes:
        code: the verdict.
        reasons: what it rests on, the deciding finding first.
        within: calibrated probability that all known outcomes are within their margins of cDBS; None where no outcome is known.
        saves: probability of less energy than cDBS; None where energy is not predicted.
        limit: for `test_with_care` alone: lowest amplitude (fraction of cDBS) of the envelope under which it may be tested.
    """

    code: Code
    reasons: tuple[Flag, ...]
    within: float | None = None
    saves: float | None = None
    limit: float | None = None

    @property
    def hazards(self) -> tuple[Flag, ...]:
        """The reasons for which it is not to be run without a clinician's word."""
        return tuple(reason for reason in self.reasons if reason.code in HAZARDS)

    @property
    def proposed(self) -> bool:
        """True where it may be proposed for a visit."""
        return self.code in ("test", "test_with_care")


def verdict(
    own: Estimate,
    cdbs: Estimate | None,
    margins: Margins,
    levels: Levels,
    *,
    harms: Sequence[Flag] = (),
    unchecked: str | None = None,
) -> Verdict:
    """Decide the verdict on a candidate.

    Args:
        own: its posterior, with the details that `ml.ope.posterior` gives (draws, behaviour, support, skill).
        cdbs: that of cDBS; None where there is none.
        margins: by how much an outcome may be worse. levels: how sure the verdict must be.
        harms: what happened under it that no clinician has cleared: `adverse_event` (a serious one), `stopped`.
        unchecked: why what the data cover could not be checked; None where it was.
    """
    gaps = slacks(own, cdbs, margins) if cdbs is not None else {}
    share = _share_within(gaps)
    within = None if share is None else calibrate(share)
    saves = _saves(own, cdbs) if cdbs is not None else None
    skill: Mapping[str, Any] = own.details.get("skill") or {}
    noted = [*_chances(within, saves, levels), *_want_of_skill(skill)]

    def conclude(code: Code, *reasons: Flag, limit: float | None = None) -> Verdict:
        return Verdict(code, (*reasons, *noted), within, saves, limit)

    hazards = [*harms, *_hazards(own, slacks(own, cdbs, margins, HARM) if cdbs is not None else {}, levels)]
    if hazards:
        return conclude("unsafe", *hazards)
    doubt = _cannot_tell(own, cdbs, gaps, saves, unchecked)
    if doubt is not None:
        return conclude("cannot_tell", doubt)
    distance = (own.details.get("behaviour") or {}).get("closeness_to_cdbs")
    if distance is not None and distance <= SAME_AMPLITUDE:
        return conclude("same_as_cdbs", Flag("acts_like_cdbs", float(distance), SAME_AMPLITUDE, "of cDBS"))
    lowest = _support(own).get("lowest_supported")
    if within is not None and 1 - within >= levels.test_within:
        return conclude("likely_worse", _likely_worse(gaps, within, levels))
    if _promising(within, saves, levels) and own.supported:
        return conclude("test")
    if _promising(within, saves, levels) and lowest is not None:
        limit = float(lowest)
        return conclude("test_with_care", Flag("extrapolates", _support(own).get("dose"), limit, "of cDBS"), _unsupported(own), limit=limit)
    return conclude("undecided", Flag("undecided") if own.supported else _unsupported(own))


def calibrate(share: float) -> float:
    """Correct a share of draws to the share of virtual patients of part A in which outcomes are truly within their margins; monotone."""
    said, true = zip(*CALIBRATION, strict=True)
    return float(np.interp(share, said, true))


def slacks(own: Estimate, cdbs: Estimate, margins: Margins, times: float = 1.0) -> dict[str, Floats]:
    """Compute by how much each known outcome keeps within so many of its margins of cDBS, draw by draw, [draws]; below 0 it is beyond.

    Raises:
        ValueError: draws of the policy and of cDBS that are not aligned.
    """
    found = {}
    for outcome, _ in PREDICTED:
        name = outcome.field
        ours, theirs = outcome_draws(own, name), outcome_draws(cdbs, name)
        if ours is None or theirs is None:
            continue
        if ours.size != theirs.size:
            raise ValueError(f"draws of {name} are not aligned: {ours.size} of the policy, {theirs.size} of cDBS")
        found[name] = outcome.slack(ours, theirs, times * margins.of(outcome))
    return found


def chance_within(own: Estimate, cdbs: Estimate, margins: Margins) -> float | None:
    """Compute the calibrated probability that every known outcome keeps within its margin of cDBS; None where none is known.

    Raises:
        ValueError: draws of the policy and of cDBS that are not aligned.
    """
    share = share_within(own, cdbs, margins)
    return None if share is None else calibrate(share)


def share_within(own: Estimate, cdbs: Estimate, margins: Margins) -> float | None:
    """Compute the share of draws in which every known outcome keeps within its margin of cDBS, as they are; None where none is known.

    Raises:
        ValueError: draws of the policy and of cDBS that are not aligned.
    """
    return _share_within(slacks(own, cdbs, margins))


def outcome_draws(estimate: Estimate, name: str) -> Floats | None:
    """Return the draws of one predicted quantity, [draws]; None where there are too few for a probability, or one is not finite."""
    drawn = np.asarray((estimate.details.get("outcome_draws") or {}).get(name) or [], dtype=np.float64)
    return drawn if drawn.size >= FEWEST_DRAWS and bool(np.isfinite(drawn).all()) else None


def interval(draws: Floats) -> tuple[float, float]:
    """Compute the 5 % and 95 % quantiles of draws, [draws], at least one; linear between neighbours, as NumPy has them.

    A page asks for hundreds of them, and for a few hundred draws NumPy's own function takes some ten times as long.
    """
    ordered = np.sort(draws)

    def at(share: float) -> float:
        place = share * (ordered.size - 1)
        below = int(place)
        above = min(below + 1, ordered.size - 1)
        return float(ordered[below] + (place - below) * (ordered[above] - ordered[below]))

    return at(0.05), at(0.95)


def _all_within(gaps: Mapping[str, Floats]) -> NDArray[np.bool_]:
    return np.asarray(np.min(np.stack(list(gaps.values())), axis=0) >= 0)


def _share_within(gaps: Mapping[str, Floats]) -> float | None:
    return float(np.mean(_all_within(gaps))) if gaps else None


def _saves(own: Estimate, cdbs: Estimate) -> float | None:
    ours, theirs = outcome_draws(own, "energy"), outcome_draws(cdbs, "energy")
    if ours is None or theirs is None:
        return None
    return float(np.mean(ours < theirs))


def _promising(within: float | None, saves: float | None, levels: Levels) -> bool:
    return within is not None and saves is not None and within >= levels.test_within and saves >= levels.test_saves


def _chances(within: float | None, saves: float | None, levels: Levels) -> tuple[Flag, ...]:
    """Return the two probabilities that every verdict states, where they are known."""
    found = []
    if within is not None:
        found.append(Flag("within_margins", within, levels.test_within, "probability"))
    if saves is not None:
        found.append(Flag("saves_energy", saves, levels.test_saves, "probability"))
    return tuple(found)


def _hazards(own: Estimate, gaps: Mapping[str, Floats], levels: Levels) -> list[Flag]:
    found = []
    off = (own.details.get("behaviour") or {}).get("below_cdbs_20_percent")
    if off is not None and off > levels.nearly_off_share:
        found.append(Flag("nearly_off", float(off), levels.nearly_off_share, "share"))
    if gaps:
        beyond = 1 - float(np.mean(_all_within(gaps)))
        if beyond >= levels.unsafe_beyond:
            found.append(Flag.of("beyond_margin", beyond, levels.unsafe_beyond, "probability", outcome=_worst(gaps)))
    return found


def _worst(gaps: Mapping[str, Floats]) -> str:
    return max(gaps, key=lambda name: float(np.mean(gaps[name] < 0)))


def _likely_worse(gaps: Mapping[str, Floats], within: float, levels: Levels) -> Flag:
    return Flag.of("likely_beyond_margin", 1 - within, levels.test_within, "probability", outcome=_worst(gaps))


def _want_of_skill(skill: Mapping[str, Any]) -> tuple[Flag, ...]:
    """Return the finding that the data cannot order policies; nothing where they can."""
    if skill.get("told", False):
        return ()
    reasons = tuple(skill.get("reasons", ()))
    return (Flag.of("no_ordering_skill", skill.get("held_out_correlation"), None, "correlation", reasons=reasons),)


def _cannot_tell(
    own: Estimate, cdbs: Estimate | None, gaps: Mapping[str, Floats], saves: float | None, unchecked: str | None
) -> Flag | None:
    """Find the reason against any verdict, whatever the policy does; None where there is none."""
    if unchecked is not None:
        return Flag.of("coverage_unchecked", text=unchecked)
    if cdbs is None:
        return Flag("reference_missing")
    if not cdbs.supported:
        return Flag("reference_unsupported")
    if not gaps:
        return Flag("outcomes_unknown")
    return None if saves is not None else Flag("energy_unknown")


def _support(estimate: Estimate) -> Mapping[str, Any]:
    return estimate.details.get("support") or {}


def _unsupported(own: Estimate) -> Flag:
    """Find the first reason that refuses the policy, or that too few sessions came near what it does."""
    refusing = next((flag for flag in own.flags if flag.refuses), None)
    return refusing or Flag("few_near_sessions", _support(own).get("near_sessions"), 2.0, "sessions")
