"""Standing of each policy in one sentence: harms first, then its own sessions, then the prediction. Every page takes it from here."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.analysis import primary_words
from app.analysis.evidence import evidence
from app.analysis.primary import confirmed_policies_of, policy_names, policy_verdicts_of, verdicts_of
from app.analysis.primary_verdict import VerdictResult
from app.evaluation import repository as evaluations
from app.evaluation.ranking import verdict_wording
from app.evaluation.ranking.decisions import Decided, findings_of
from app.evaluation.ranking.judged import judged
from app.study.adverse_events import blocking_events, events_of_participant
from app.tables.participants import Participant
from ml.ope import Flag
from ml.statistics.noninferiority import PLANNED_SESSIONS


@dataclass(frozen=True)
class Standing:
    """Evidence on one policy.

    Attributes:
        harms: serious adverse events and stops that no clinician has cleared. sessions: its own sessions that count.
        measured: verdict on these sessions; None without any. confirmed: on those after its confirmation was declared.
        predicted: verdict of the newest ranking; None where it has none.
    """

    name: str
    harms: tuple[Flag, ...]
    sessions: int
    measured: VerdictResult | None
    predicted: Decided | None
    confirmed: VerdictResult | None = None

    @property
    def sentence(self) -> str:
        """Standing in words."""
        return f"{self.name}. " + " ".join(part for part in (self._harms(), self._measurement(), self._prediction()) if part)

    def _harms(self) -> str:
        return f"Held back: {verdict_wording.plainly(self.harms)}." if self.harms else ""

    def _measurement(self) -> str:
        confirmed = "" if self.confirmed is None else f"Declared confirmation: {primary_words.verdict(self.confirmed, self.name)}"
        if self.confirmed is not None and not primary_words.is_open(self.confirmed):
            return confirmed
        if self.measured is None:
            return f"{confirmed} Not tested.".strip()
        return f"{confirmed} Measured, exploratory: {primary_words.verdict(self.measured, self.name)}".strip()

    def _prediction(self) -> str:
        if self.predicted is None:
            return "Not ranked."
        why = verdict_wording.plainly(self.predicted.hazards or self.predicted.reasons)
        code = verdict_wording.STANDING_NAMES[self.predicted.standing]
        settled = any(v is not None and not primary_words.is_open(v) for v in (self.confirmed, self.measured))
        return f"Predicted: {code}{f' ({why})' if why else ''}.{' The measurement counts before the prediction.' if settled else ''}"


def standings(db: Session, participant: Participant, caller: Caller) -> dict[int, Standing]:
    """Return the standing of every policy that was ranked, ran, or did harm, as the caller may know it; none to a blinded assessor."""
    if caller.is_blinded:
        return {}
    held = evidence(db, participant, caller)
    measured, confirmed = policy_verdicts_of(held, participant), confirmed_policies_of(db, held)
    newest = evaluations.newest_evaluation(db, participant.id)
    ranked = judged(db, participant, newest).assessment.candidates if newest is not None else []
    predicted = {a.policy.id: a.decided for a in ranked}
    harms = {i: findings_of(events) for i, events in blocking_events(events_of_participant(db, participant.id), caller).items()}
    names = policy_names(db, participant)
    counts = [s.arm.policy_id for s in held.sessions]
    return {
        i: Standing(names[i], harms.get(i, ()), counts.count(i), measured.get(i), predicted.get(i), confirmed.get(i))
        for i in sorted(confirmed.keys() | measured.keys() | predicted.keys() | harms.keys())
        if i in names
    }


def standing_sentences(db: Session, participant: Participant, caller: Caller, *, every: bool = True) -> dict[int, str]:
    """Return the sentences by policy; without `every` only of policies with sessions or harms, for pages that list many."""
    found = standings(db, participant, caller)
    return {i: one.sentence for i, one in found.items() if every or one.harms or one.sessions}


def outlook(db: Session, participant: Participant, caller: Caller) -> list[str]:
    """Return a sentence on every learned controller that was tested: what further visits would settle.

    It follows the confirmatory verdict where margins are locked.
    """
    found: dict[str, str] = {}
    for result in verdicts_of(db, participant, caller):
        found.setdefault(result.controller.value, primary_words.outlook(result, PLANNED_SESSIONS))
    return list(found.values())
