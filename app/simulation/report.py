"""Report of a simulated study at its end: the paper's table of trial time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from rich.table import Table
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.analysis.pooled import TrialTime, trial_time
from app.study import repository as study


def as_table(db: Session, codes: Sequence[str], caller: Caller) -> Table:
    """Tabulate the minutes per controller and participant, with the number of sessions in brackets."""
    trial = _trial(db, codes, caller)
    table = Table(title="Trial time, minutes (sessions)", caption="Synthetic participants, not fitted to patients.")
    table.add_column("Participant")
    for label in trial.labels:
        table.add_column(label, justify="right")
    for row in trial.rows:
        table.add_row(row.participant, *(f"{t.minutes:.0f} ({t.sessions})" for t in row.tested))
    return table


def as_dict(db: Session, codes: Sequence[str], caller: Caller) -> dict[str, Any]:
    """Return minutes and sessions per participant and controller, for a program."""
    return {
        row.participant: {t.controller.value: {"minutes": t.minutes, "sessions": t.sessions} for t in row.tested}
        for row in _trial(db, codes, caller).rows
    }


def _trial(db: Session, codes: Sequence[str], caller: Caller) -> TrialTime:
    return trial_time(db, [study.participant_by_code(db, code, caller) for code in codes], caller)
