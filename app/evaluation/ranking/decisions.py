"""The verdict on each candidate of an evaluation: from the posterior, the participant's margins and levels, and what is known besides."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from app.evaluation.schemas import Decision, Standing
from app.study.margins import margins_of
from app.tables.adverse_events import AdverseEvent
from app.tables.evaluations import Evaluation
from app.tables.participants import MarginsVersion
from ml.ope import FEWEST_VISITS, HAZARDS, POSTERIOR, SETTLED_BY_SESSIONS, Estimate, Flag, Levels, Verdict, gain_over, verdict
from ml.ope.posterior.further_sessions import Further, Place, further_sessions

SESSION_NOISE = "session_noise"
"""Member of what `check_coverage` found: standard deviation of each outcome from session to session."""


@dataclass(frozen=True)
class Circumstances:
    """Inputs that verdicts of one evaluation share.

    Attributes:
        evaluation_id, evaluated_at: of the evaluation.
        margins: of the participant, in force now: those of the newest lock, else the newest. levels: the newest version, locked or not.
        unchecked: why the coverage by the data could not be checked; None where it was.
        noise: of a session, by outcome. place: range in which a plan may keep sessions near an amplitude, B among it.
        cdbs_ma: the cDBS amplitude, mA; None where it is not known.
        `held`: constants, the amplitude (fraction of cDBS) of each with its posterior: they show what sessions near an amplitude would
            show.
    """

    evaluation_id: int
    evaluated_at: datetime
    margins: MarginsVersion
    levels: MarginsVersion
    unchecked: str | None
    noise: Mapping[str, float]
    place: Place
    cdbs_ma: float | None
    held: tuple[tuple[float, Estimate], ...] = ()


@dataclass(frozen=True)
class Decided:
    """A verdict with its reasons, in the order in which they count; `verdict_wording.decision` makes a sentence of them."""

    decision: Decision
    reasons: tuple[Flag, ...]
    verdict: Verdict | None = None
    further: Further | None = None

    @property
    def hazards(self) -> tuple[Flag, ...]:
        """The reasons for which it is not to be run without a clinician's word."""
        return tuple(reason for reason in self.reasons if reason.code in HAZARDS)

    @property
    def needs_override(self) -> bool:
        """True where it may only be planned with a clinician's stated reason."""
        return self.decision in ("unsafe", "likely_worse") or bool(self.hazards)

    @property
    def standing(self) -> Standing:
        """The verdict as a page shows it: what is dangerous is not advised, also where the data cannot decide the rest."""
        return "not_advised" if self.hazards and self.decision != "unsafe" else self.decision

    @property
    def limit(self) -> float | None:
        """For a test with care: the lowest amplitude of its envelope, fraction of cDBS."""
        return self.verdict.limit if self.verdict else None


def decide(
    estimates: Mapping[str, Estimate],
    cdbs: Mapping[str, Estimate],
    method: str,
    given: Circumstances,
    policy_id: int,
    *,
    retired_reason: str | None = None,
    harms: tuple[Flag, ...] = (),
) -> Decided:
    """Decide the verdict on one candidate.

    A retired policy has no verdict: it is not proposed, whatever is predicted. Nor can one of an evaluation without a posterior: a single
    method knows no chance of keeping within the margins. It is unsafe where the whole interval of its gain over cDBS is below 0. A serious
    adverse event and a stop count whatever else is known.

    Args:
        estimates: of the candidate, by method. cdbs: of the cDBS reference, by method; empty where it has none.
        method: that the evaluation ranks by.
        given: what all verdicts of the evaluation share. policy_id: whose.
        retired_reason: why a person withdrew it.
        harms: what happened under it that no clinician has cleared, as `findings_of` gives it.
    """
    if retired_reason:
        return Decided("cannot_tell", (Flag.of("retired", text=retired_reason), *harms))
    own = estimates.get(POSTERIOR)
    if own is None:
        known = _without_posterior(estimates.get(method), cdbs.get(method))
        return Decided("unsafe", (*harms, *known.reasons)) if harms else known
    reference, levels = cdbs.get(POSTERIOR), levels_of(given.levels)
    found = verdict(own, reference, margins_of(given.margins), levels, harms=harms, unchecked=given.unchecked)
    ordered = all(reason.code != "no_ordering_skill" for reason in found.reasons)
    if found.code != "undecided" or found.reasons[0].code not in SETTLED_BY_SESSIONS or not ordered:
        return Decided(found.code, found.reasons, found)
    if not given.noise:
        return Decided(found.code, found.reasons, found)  # how much a session shows is not known
    further = _further(own, reference, given, levels, policy_id)
    return Decided(found.code, (*found.reasons, *_of_sessions(further, given.cdbs_ma)), found, further)


def findings_of(events: Sequence[AdverseEvent]) -> tuple[Flag, ...]:
    """Return the findings that follow from adverse events that block a policy: a serious event first, then stops."""
    serious = any(event.now.serious for event in events)
    stops = sum(event.is_stop for event in events)
    return (Flag("adverse_event"),) * serious + ((Flag("stopped", float(stops), None, "stops"),) if stops else ())


def levels_of(margins: MarginsVersion) -> Levels:
    """Convert the levels of a version for the analyses."""
    return Levels(margins.test_within, margins.test_saves, margins.unsafe_beyond, margins.nearly_off_share)


def ordering_told(posterior: Mapping[int, Estimate]) -> bool:
    """Check whether the data can order policies; True where an evaluation has no posterior, and its order is that of a single method."""
    return all((e.details.get("skill") or {}).get("told", False) for e in posterior.values())


def session_noise(evaluation: Evaluation) -> dict[str, float]:
    """Return the standard deviation of each outcome from session to session when the evaluation was made; empty where it is not known."""
    stored: Mapping[str, Any] = evaluation.diagnostics.get("coverage") or {}
    return {name: float(v) for name, v in (stored.get(SESSION_NOISE) or {}).items()}


def _without_posterior(own: Estimate | None, reference: Estimate | None) -> Decided:
    unknown = Flag("no_posterior")
    if own is not None and reference is not None:
        over = gain_over(own, reference)
        if over.high < 0:
            return Decided("unsafe", (Flag("all_below_zero", over.high, 0.0, "reward"), unknown))
    return Decided("cannot_tell", (unknown,))


_needed: OrderedDict[tuple[int, datetime, int, int, int], Further | None] = OrderedDict()
"""Simulated numbers of sessions by evaluation, policy and versions of margins and levels, none of which ever changes."""
_KEPT = 5000


def _further(own: Estimate, cdbs: Estimate | None, given: Circumstances, levels: Levels, policy_id: int) -> Further | None:
    """Find how many further sessions near which amplitude would decide; None where none would that a plan can contain."""
    if cdbs is None:
        return None
    key = (given.evaluation_id, given.evaluated_at, policy_id, given.margins.id, given.levels.id)
    if key not in _needed:
        _needed[key] = further_sessions(own, cdbs, given.held, given.noise, margins_of(given.margins), levels, given.place)
        while len(_needed) > _KEPT:
            _needed.popitem(last=False)
    return _needed[key]


def _of_sessions(further: Further | None, cdbs_ma: float | None) -> tuple[Flag, ...]:
    """List the sessions that would decide as findings, or that none would."""
    if further is None:
        return (Flag("not_settled_by_sessions"),)
    at = Flag("near_amplitude", further.fraction, None, "of cDBS")
    if cdbs_ma is not None:
        at = Flag("near_amplitude", further.fraction * cdbs_ma, None, "mA")
    needed = Flag("sessions_needed", float(further.sessions), None, "sessions")
    if further.visits < FEWEST_VISITS:
        return (needed, at)
    return (needed, Flag("visits_needed", float(further.visits), None, "visits"), at)
