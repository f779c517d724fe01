"""Dose that was in force before the sessions of a buffer.

A session's log begins with its first step, yet stimulation acts over minutes. The dose before it is still at work while the discount is
largest. Between sessions a participant is under clinical stimulation (cDBS), so that is expected. But a study may do otherwise, and some
sessions do not record it. Where the amplitude in force before a session is on record, that is it (`ml.ope.doses.lead_dose`). For the
others, the evidence of the linear model of beta weighs the two accounts.
"""

from __future__ import annotations

from ml.ope.linear.dynamics import SessionTable, fit_dynamics
from ml.ope.scale import learn_scale
from ml.trajectories import ReplayBuffer

CDBS = 1.0
"""Amplitude fraction of clinical stimulation."""

PRIOR_LOG_ODDS = 2.0
"""Of cDBS between sessions against each session's first amplitude: the protocol of the study has it so."""


def dose_before(buffer: ReplayBuffer) -> float | None:
    """Choose the amplitude fraction before sessions without a record of it; None where each session's first amplitude explains beta better.

    cDBS where every session has a record, or fewer than two sessions have usable steps, so that nothing can be weighed.
    """
    if all(s.lead_amplitude is not None for s in buffer.sessions):
        return CDBS
    scale = learn_scale(buffer)

    def evidence(before: float | None) -> float:
        tables = [SessionTable.of(s, scale, before) for s in buffer.sessions]
        return fit_dynamics(buffer, tables, 1, 0, before)[0].log_evidence

    if sum(bool(s.usable().any()) for s in buffer.sessions) < 2:
        return CDBS
    return CDBS if evidence(CDBS) + PRIOR_LOG_ODDS >= evidence(None) else None
