"""A session's steps as the science reads them, or the reason of its own why they cannot be read."""

from __future__ import annotations

import numpy as np

from app.platform import files
from app.study import cdbs_amplitude
from app.study.blinding import Arm
from app.study.sessions.designs import drawn
from app.study.sessions.usable_steps import qoc_of
from app.study.traces import StepTable, amplitude_program
from app.tables.participants import SettingsVersion
from app.tables.sessions import Controller, StudySession
from ml.qoc import Qoc
from ml.trajectories import ReplayBuffer, SessionTrajectory, from_parquet

# The replay buffer of a stored snapshot.


def read_buffer(sha256: str) -> ReplayBuffer:
    """Read a stored snapshot's buffer, by the hash of its file."""
    return from_parquet(files.read(sha256))


def trajectory_of(session: StudySession, table: StepTable, arm: Arm, version: SettingsVersion, failed: Qoc) -> SessionTrajectory | str:
    """Build a trajectory of the session's steps after its start, with the window of beta before it; or the reason why there are none.

    Args:
        session: its QoCs are taken in their newest revision. table: its steps, [window + T].
        arm: what drove it, as far as the asker may know.
        version: W, and how many steps of a state may be imputed (one is always measured).
        failed: the QoCs of a stopped session (`failed_qoc_of` the participant's sessions).

    B of a random session and the amplitude before it are those of its conditions, whatever the settings say today.
    """
    reason = own_reason(session, table)
    if reason is not None:
        return reason
    window, conditions = version.window, session.conditions
    lead_ma = conditions.lead_amplitude_ma if conditions else None
    by_design = drawn(conditions, table) if arm.controller is Controller.RANDOM and conditions is not None else None
    return SessionTrajectory(
        session_id=session.id,
        visit=session.visit.number,
        controller=arm.controller.value,
        policy_id=arm.policy_id,
        lead_beta=table.beta[:window],
        beta=table.beta[window:],
        amplitude=table.fraction[window:],
        qoc=qoc_of(session),
        random_bound=conditions.bound if by_design and conditions and by_design.density_told else None,
        holds=by_design.holds if by_design else (),
        lead_amplitude=lead_ma / table.cdbs_ma if lead_ma is not None and table.cdbs_ma else None,
        most_imputed=min(version.most_imputed, window - 1),
        stopped_as=failed if session.stopped_reason is not None else None,
    )


def own_reason(session: StudySession, table: StepTable) -> str | None:
    """Find the first reason of the session's own against reading its steps; None where there is none."""
    if session.excluded_reason:
        return f"excluded by a person: {session.excluded_reason}"
    if table.beta_trace is None:
        channel = f"'{session.control_stream}'" + (f" on channel '{session.control_channel}'" if session.control_channel else "")
        return f"no beta trace {channel} in its recordings"
    if table.amplitude_trace is None:
        return "no amplitude trace in its recordings"
    if np.isnan(table.fraction).all():
        if table.cdbs_ma is not None:
            return "no valid amplitude"
        program = amplitude_program(table.amplitude_trace)
        why = cdbs_amplitude.lacking(session.visit, session.hemisphere, session.visit.participant.current_settings, program)
        return f"{why}, so that milliamperes give no fraction"
    if not (table.t_s > 0).any():
        return "shorter than one step"
    return None
