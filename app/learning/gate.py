"""The gate of the replay buffer: when sessions of learned policies may enter it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from math import comb
from statistics import median

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import SYSTEM, Caller
from app.learning import repository
from app.platform.database import set_reason
from app.platform.errors import Invalid
from app.study import access, blinding
from app.tables.learning import BufferGateDecision, GateChoice
from app.tables.participants import Participant
from app.tables.sessions import LEARNED, Controller, StudySession
from ml.outcomes import OUTCOMES
from ml.outcomes.records import Outcome
from ml.statistics.multiplicity import holm
from ml.statistics.ranksum import p_greater

# The gate of the replay buffer: sessions of learned policies enter once their QoCs are significantly better than the random controller's.
#
# Source: Gao et al. 2023, section 4.1, which names no test. Ours: each QoC that counts in r_end has a one-sided rank-sum test of all RL
# and distilled sessions against all random ones, Holm-adjusted. The gate opens when at least one QoC is better and none is worse. A
# clinician may decide otherwise with a reason; the decision stays on record and applies until the next one.

ALPHA = 0.05


@dataclass(frozen=True)
class QocTest:
    """One QoC of learned policies against the random controller.

    Attributes:
        n_learned, n_random: sessions with a value. median_learned, median_random: None without one.
        p_better, p_worse: one-sided, Holm-adjusted over the QoCs tested; None where there is not enough data.
    """

    field: str
    name: str
    unit: str
    n_learned: int
    n_random: int
    median_learned: float | None
    median_random: float | None
    p_better: float | None = None
    p_worse: float | None = None

    @property
    def tested(self) -> bool:
        """True where there were enough sessions for a test."""
        return self.p_better is not None


@dataclass(frozen=True)
class Gate:
    """Decision whether sessions of learned policies may enter the buffer, with its reasons.

    Attributes:
        tests: one per QoC that counts.
        opened_by_test: what the tests say.
        decision: the clinician's newest decision; None where there is none.
    """

    tests: tuple[QocTest, ...]
    opened_by_test: bool
    decision: BufferGateDecision | None

    @property
    def is_open(self) -> bool:
        """The decision where there is one that does not follow the tests, else the tests."""
        if self.decision is None or self.decision.choice == GateChoice.TEST:
            return self.opened_by_test
        return self.decision.choice == GateChoice.OPEN


def gate(db: Session, participant: Participant, sessions: Sequence[StudySession]) -> Gate:
    """Determine the gate from the participant's confirmed sessions, without excluded ones and those of a plan whose key is sealed."""
    live = [s for s in sessions if s.status == "confirmed" and not s.excluded_reason and not s.visit.sealed]
    arms = [(s, blinding.arm(s, SYSTEM).controller) for s in live]
    learned = [s for s, controller in arms if controller in LEARNED]
    random = [s for s, controller in arms if controller is Controller.RANDOM]
    raw = [_compare(o, learned, random) for o in OUTCOMES if o.end and o.end.weight(participant.current_settings)]
    tests = _adjusted(raw)
    better = any(t.p_better is not None and t.p_better < ALPHA for t in tests)
    worse = any(t.p_worse is not None and t.p_worse < ALPHA for t in tests)
    return Gate(tests, better and not worse, repository.newest_gate_decision(db, participant.id))


def decide(db: Session, participant: Participant, choice: GateChoice, reason: str, caller: Caller) -> BufferGateDecision:
    """Record a clinician's decision; the caller commits.

    Raises:
        Invalid: no reason. Forbidden: the caller approves no plans in this study.
    """
    access.require(caller, can.DECIDE_GATE, participant)
    if not reason.strip():
        raise Invalid("A decision on what policies learn from needs its reason.", "Say why in a sentence.", field="reason")
    row = BufferGateDecision(participant_id=participant.id, choice=choice, reason=reason.strip(), created_by=caller.label)
    set_reason(db, row.reason)
    db.add(row)
    db.flush()
    return row


def _compare(outcome: Outcome, learned: Sequence[StudySession], random: Sequence[StudySession]) -> QocTest:
    """Run the unadjusted one-sided tests of one outcome."""
    named = outcome.field, outcome.label, outcome.unit
    x, y = _values(learned, outcome), _values(random, outcome)
    medians = (median(x) if x else None, median(y) if y else None)
    if not x or not y or 1 / comb(len(x) + len(y), len(x)) >= ALPHA:
        return QocTest(*named, len(x), len(y), *medians)
    a, b = [-outcome.loss(v) for v in x], [-outcome.loss(v) for v in y]
    return QocTest(*named, len(x), len(y), *medians, p_better=p_greater(a, b), p_worse=p_greater(b, a))


def _values(sessions: Sequence[StudySession], outcome: Outcome) -> list[float]:
    found = (s.qoc.value(outcome) for s in sessions if s.qoc is not None)
    return [float(v) for v in found if v is not None]


def _adjusted(tests: Sequence[QocTest]) -> tuple[QocTest, ...]:
    """Adjust both families of p-values by Holm's method, over the QoCs that could be tested."""
    tested = [t for t in tests if t.tested]
    better, worse = (iter(holm([getattr(t, name) for t in tested])) for name in ("p_better", "p_worse"))
    return tuple(t if not t.tested else replace(t, p_better=next(better), p_worse=next(worse)) for t in tests)


def gate_grounds(gate: Gate) -> str:
    """Say why the gate of the replay buffer is open or shut."""
    if gate.decision is not None and gate.decision.choice != GateChoice.TEST:
        return f"decided by {gate.decision.created_by}: {gate.decision.reason}"
    if gate.opened_by_test:
        better = [t.name.lower() for t in gate.tests if t.p_better is not None and t.p_better < ALPHA]
        return f"{' and '.join(better)} significantly better than under the random controller (Holm-adjusted p < {ALPHA})"
    worse = [t.name.lower() for t in gate.tests if t.p_worse is not None and t.p_worse < ALPHA]
    if worse:
        return f"{' and '.join(worse)} significantly worse than under the random controller"
    if not gate.tests:
        return "no outcome counts in the reward of a session's end (C2 = C3 = C4 = 0), so nothing can be tested"
    if not any(t.tested for t in gate.tests):
        return gate_test_note(gate.tests[0])
    return "no outcome is significantly better than under the random controller"


def gate_test_note(test: QocTest) -> str:
    """Say why a QoC could not be tested; empty where it was."""
    if test.tested:
        return ""
    return (
        f"not enough sessions with {test.name.lower()}: {test.n_learned} of learned policies and {test.n_random} of the random controller "
        "(3 against 4, 2 against 5 or 1 against 20 are the fewest that can show a difference)"
    )
