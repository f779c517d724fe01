"""Options of a run of `betaloop control`."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from pathlib import Path


@dataclass(frozen=True, kw_only=True)
class Task:
    """Options of a run.

    Attributes:
        log: CSV to write, one row per decision; a session with a device side needs it.
        key: as `app.tablet.command.verified` takes it.
        participant: code that the bundle must be of.
        battery: JSON file with assumptions about the implant, as `read_implant` takes it.
        bench: without a participant, so that any bundle may run with a device side, and as often as wanted.
        ledger: folder of the runs of this tablet; the one in the home folder when None. withdrawn: the study's list of withdrawals.
        timed: so many decisions are timed first.
        begins: when a session on a simulated device begins, by the simulation's clock; now when None.
    """

    log: Path | None = None
    key: str | None = None
    participant: str | None = None
    battery: Path | None = None
    bench: bool = False
    ledger: Path | None = None
    withdrawn: Path | None = None
    timed: int = 0
    begins: datetime | None = None
