"""One session as pages, analyses and buffers read it: its steps, its beta threshold where unit and source fit, its QoCs."""

from __future__ import annotations

from dataclasses import dataclass

from sqlalchemy.orm import Session

from app.study.models import SettingsVersion, StudySession
from app.study.traces import StepTable, TracesOf, laid_out, step_table
from ml.qoc import Qoc


@dataclass(frozen=True)
class SessionData:
    """A session with its step table under the participant's present settings."""

    session: StudySession
    settings: SettingsVersion
    table: StepTable

    @property
    def threshold_mismatch(self) -> str:
        """Why the participant's threshold says nothing about this trace; empty where it does. Units and sources are never mixed."""
        trace, settings = self.table.beta_trace, self.settings
        if trace is None or settings.xi_beta is None:
            return ""
        unstated = [name for name, value in (("unit", settings.beta_unit), ("source", settings.beta_source)) if not value]
        if unstated:
            return (
                f"Nobody has stated the {' and the '.join(unstated)} of the threshold of {settings.xi_beta:g}; this trace is in "
                f"{trace.unit} from {trace.source}. State unit and source in the participant's settings."
            )
        wanted = (settings.beta_unit, settings.beta_source)
        if (trace.unit, trace.source) == wanted:
            return ""
        return (
            f"The threshold of {settings.xi_beta:g} is in {wanted[0]} from {wanted[1]}; this trace is in {trace.unit} from {trace.source}. "
            "They are not comparable."
        )

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
    return Qoc() if row is None else Qoc(row.grasp_hz, row.rating, row.tremor_percent)
