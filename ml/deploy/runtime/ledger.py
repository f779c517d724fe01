"""Slots that this tablet has run: a folder with one file per slot, made before the first amplitude and never taken back.

A file is made whole or not at all, and reaches the disk before stimulation changes. So a killed process, a second process that starts at
the same time, and a new bundle of the same slot all find it. Withdrawals, and the latest time that the tablet has seen, are remembered too.
So a clock that is set back opens nothing.
"""

from __future__ import annotations

import csv
import json
import os
import re
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from .slot import NotAllowed, Refusal, Slot, Withdrawals, withdrawals_body, withdrawals_of

CLOCK_TOLERANCE = timedelta(minutes=2)
"""A clock may be set back by this much, as time servers do, without being doubted."""
_LATEST, _WITHDRAWN = "latest-time", "withdrawn.json"


@dataclass(frozen=True)
class Ledger:
    """The runs of a tablet.

    Args:
        folder: made when first needed.
    """

    folder: Path

    def check_clock(self, now: datetime) -> None:
        """Raise NotAllowed where the tablet's clock is on a day before one that it has shown already.

        Within a day a clock that was fast may be set right. That opens nothing: a slot runs once, on its own day alone, and withdrawals are
        remembered.
        """
        latest = self._latest()
        if latest is not None and now < latest - CLOCK_TOLERANCE and now.date() < latest.astimezone(now.tzinfo).date():
            raise NotAllowed(
                Refusal.CLOCK,
                f"the tablet's clock says {now:%Y-%m-%d %H:%M} and has said {latest.astimezone(now.tzinfo):%Y-%m-%d %H:%M} before: set it",
            )

    def withdraw(self, withdrawn: Withdrawals) -> None:
        """Remember what was withdrawn. Raises NotAllowed for a list older than the one that is known."""
        known = self.withdrawn()
        if known is not None and datetime.fromisoformat(withdrawn.issued_at) < datetime.fromisoformat(known.issued_at):
            raise NotAllowed(Refusal.WITHDRAWN, f"the list of withdrawals of {withdrawn.issued_at} is older than the one that is known")
        self._replace(_WITHDRAWN, withdrawals_body(withdrawn))

    def withdrawn(self) -> Withdrawals | None:
        """Read the newest list of withdrawals that this tablet was given."""
        try:
            return withdrawals_of(json.loads((self.folder / _WITHDRAWN).read_bytes()))
        except FileNotFoundError:
            return None
        except (ValueError, KeyError, TypeError) as error:
            raise NotAllowed(Refusal.WITHDRAWN, f"{self.folder / _WITHDRAWN} is damaged: give the tablet the study's list anew") from error

    def check_unused(self, participant: str, slot: Slot) -> None:
        """Raise NotAllowed where the slot was begun already; says when, and how it ended."""
        try:
            lines = self._file(participant, slot).read_text("utf-8").splitlines()
        except FileNotFoundError:
            return
        raise _refusal_of_run(slot, lines)

    def begin(self, participant: str, slot: Slot, now: datetime, log: Path, manifest_sha256: str) -> None:
        """Note that a slot runs from now on. Raises NotAllowed where it was begun already, by another process too."""
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self._file(participant, slot)
        draft = path.with_suffix(f".{os.getpid()}.draft")
        facts = {"began": now.isoformat(timespec="seconds"), "log": str(log.resolve()), "manifest": manifest_sha256, "pid": os.getpid()}
        _write(draft, json.dumps(facts) + "\n", "w")
        try:
            os.link(draft, path)  # of two that start at once, one gets the name
        except FileExistsError:
            self.check_unused(participant, slot)
        finally:
            draft.unlink()
        _sync_folder(self.folder)
        self._replace(_LATEST, max(now, self._latest() or now).isoformat().encode())

    def end(self, participant: str, slot: Slot, now: datetime, how: str, decisions: int) -> None:
        """Note how the run ended."""
        facts = {"ended": now.isoformat(timespec="seconds"), "how": how, "decisions": decisions}
        _write(self._file(participant, slot), json.dumps(facts) + "\n", "a")

    def _file(self, participant: str, slot: Slot) -> Path:
        return self.folder / f"{re.sub('[^A-Za-z0-9-]', '_', participant)}-plan-{slot.plan_id}-slot-{slot.slot_id}.run"

    def _latest(self) -> datetime | None:
        try:
            return datetime.fromisoformat((self.folder / _LATEST).read_text("ascii"))
        except FileNotFoundError:
            return None
        except ValueError as error:
            raise NotAllowed(Refusal.CLOCK, f"{self.folder / _LATEST} is damaged: check the tablet's clock and remove that file") from error

    def _replace(self, name: str, content: bytes) -> None:
        self.folder.mkdir(parents=True, exist_ok=True)
        draft = self.folder / f"{name}.{os.getpid()}.draft"
        _write(draft, content.decode(), "w")
        draft.replace(self.folder / name)
        _sync_folder(self.folder)


def _refusal_of_run(slot: Slot, lines: list[str]) -> NotAllowed:
    """Describe what is known of a run that was begun."""
    try:
        notes: dict[str, Any] = {}
        for line in lines:
            notes |= json.loads(line)
    except ValueError:
        notes = {}  # cut off in the middle of a line: it was begun all the same
    began = f"began at {notes['began']}" if "began" in notes else "was begun"
    if "ended" in notes:
        message = f"session {slot.position} of this plan {began} and ended at {notes['ended']} ({notes['how']}); a slot runs once"
        return NotAllowed(Refusal.ALREADY_RUN, f"{message}: plan a repeat to run it again")
    done = _last_row(Path(str(notes.get("log", ""))))
    return NotAllowed(
        Refusal.BROKEN_OFF,
        f"session {slot.position} of this plan {began} and was broken off{done}. The device is back on clinical settings, and the log can "
        "be uploaded; a slot runs once: plan a repeat to run it again",
    )


def _last_row(log: Path) -> str:
    """Describe how far a log came; nothing where there is none."""
    try:
        with log.open(encoding="utf-8", newline="") as stream:
            rows = list(csv.DictReader(line for line in stream if not line.startswith("#") and line.endswith("\n")))
    except OSError:
        return ""
    if not rows:
        return " before its first decision"
    return f" after {len(rows)} decisions, the last at {float(rows[-1]['t_s']):.0f} s with {float(rows[-1]['amplitude_ma']):g} mA ({log})"


def _write(path: Path, text: str, mode: str) -> None:
    with path.open(mode, encoding="utf-8") as stream:
        stream.write(text)
        stream.flush()
        os.fsync(stream.fileno())


def _sync_folder(folder: Path) -> None:
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
