"""One session as pages, analyses and buffers read it: its steps, its beta threshold where unit and source fit, its QoCs."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

from sqlalchemy.orm import Session

from app.study.threshold import mismatch
from app.study.traces import StepTable, TracesOf, laid_out, step_table
from app.tables.participants import SettingsVersion
from app.tables.sessions import StudySession
from ml.outcomes import OUTCOMES
from ml.qoc import Qoc, failed_qoc


@dataclass(frozen=True)
class SessionData:
    """A session with its step table under the participant's present settings."""

    session: StudySession
    settings: SettingsVersion
    table: StepTable

    @property
    def threshold_mismatch(self) -> str:
        """Why the participant's threshold says nothing about this trace; empty where it does."""
        return mismatch(self.settings, self.table.beta_trace)

    @property
    def threshold(self) -> float | None:
        """xi_beta, where it is stated to be in the unit and from the source of this trace."""
        return None if self.threshold_mismatch else self.settings.xi_beta


def session_data(db: Session, session: StudySession, traces: TracesOf | None = None) -> SessionData:
    """Beta and amplitude of a session, from `traces` where the caller has read those of many sessions at once."""
    settings = session.visit.participant.current_settings
    table = step_table(db, session, settings) if traces is None else laid_out(session, settings, traces)
    return SessionData(session, settings, table)


def qoc_of(session: StudySession) -> Qoc:
    """A session's QoCs as the science knows them."""
    row = session.qoc
    return Qoc() if row is None else Qoc(**{o.field: getattr(row, o.field) for o in OUTCOMES})


def failed_qoc_of(sessions: Iterable[StudySession]) -> Qoc:
    """Return what a stopped session of a participant counts as, in buffers, rankings and analyses alike.

    Args:
        sessions: all of the participant. Those count that are confirmed, not excluded, and of no sealed visit.
    """
    return failed_qoc(qoc_of(s) for s in sessions if s.status == "confirmed" and not s.excluded_reason and not s.visit.sealed)
