"""Sentences of learning, made of typed values at the last moment; nothing reads them back."""

from __future__ import annotations

from collections.abc import Sequence

from app.learning.gate.service import ALPHA, Gate, QocTest
from app.learning.sweeps.parallel import Standing
from app.study.sessions.programming import Difference
from app.tables.learning import GateChoice

STANDINGS = {
    Standing.RETIRED: "retired",
    Standing.BELOW_TRIED: "below what the random controller tried",
    Standing.NO_SESSION_NEAR: "no session near",
    Standing.BEYOND_MARGIN: "probably beyond a margin",
    Standing.ABOVE_CDBS: "estimated above cDBS",
    Standing.NOT_ABOVE_CDBS: "not above cDBS with confidence",
    Standing.UNTOLD: "cannot tell",
}


def gate_grounds(gate: Gate) -> str:
    """Why the gate of the replay buffer is open or shut."""
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
    """Why a QoC could not be tested; empty where it was."""
    if test.tested:
        return ""
    return (
        f"not enough sessions with {test.name.lower()}: {test.n_learned} of learned policies and {test.n_random} of the random controller "
        "(3 against 4, 2 against 5 or 1 against 20 are the fewest that can show a difference)"
    )


def other_programming(differs: Sequence[Difference]) -> str:
    """Why a session under another programming than the participant's newest stays out of a buffer."""
    parts = [f"{d.of} and not {d.other} on {f'the {d.hemisphere} ' if d.hemisphere else ''}program {d.program}" for d in differs]
    return (
        f"it ran under another programming than the participant's newest session: {'; '.join(parts)}. The same fraction is another dose "
        "there; a clinician may pool both in the settings"
    )
