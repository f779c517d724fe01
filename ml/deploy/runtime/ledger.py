"""Slots that this tablet has run: a folder with one file per slot, and in it a line for each event of each attempt.

A slot is used once its policy or schedule has decided. That line reaches the disk before the amplitude leaves, so a killed process and a
new bundle of the same slot find it. An attempt that ended earlier, as one with another device, leaves the slot free for the next attempt
under the same signature. A running attempt locks its file. Withdrawals, and the latest time that the tablet has seen, are remembered too,
so that a clock that is set back opens nothing.
"""

from __future__ import annotations

import csv
import json
import os
import re
from dataclasses import dataclass
from datetime import datetime, timedelta
from io import TextIOWrapper
from pathlib import Path
from typing import Any

from .slot import NotAllowed, Refusal, Slot, Withdrawals, withdrawals_body, withdrawals_of

try:
    import fcntl
except ImportError:  # a system without such locks: there a slot is used once it was begun
    fcntl = None  # type: ignore[assignment]

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
                f"the tablet's clock says {now:%Y-%m-%d %H:%M} and showed {latest.astimezone(now.tzinfo):%Y-%m-%d %H:%M} before: set it",
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
            raise NotAllowed(Refusal.WITHDRAWN, f"{self.folder / _WITHDRAWN} is damaged: give the tablet the study's list again") from error

    def check_unused(self, participant: str, slot: Slot) -> None:
        """Raise NotAllowed where the policy or schedule of a slot has decided already; says when, and how it ended."""
        try:
            _check_free(slot, _attempts(self._file(participant, slot).read_text("utf-8")))
        except FileNotFoundError:
            return

    def begin(self, participant: str, slot: Slot, now: datetime, log: Path, manifest_sha256: str) -> Attempt:
        """Note that an attempt at a slot begins. Raises NotAllowed where the slot is used, or another process runs it."""
        self.folder.mkdir(parents=True, exist_ok=True)
        path = self._file(participant, slot)
        try:
            file = path.open("a+" if fcntl else "x+", encoding="utf-8")
        except FileExistsError:
            raise _refusal_of_use(slot, {}) from None
        try:
            if fcntl:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            file.seek(0)
            text = file.read()
            earlier = _attempts(text)
            _check_free(slot, earlier)
            attempt = Attempt(len(earlier) + 1, file)
            facts = {"began": now.isoformat(timespec="seconds"), "attempt": attempt.number, "log": str(log.resolve())}
            file.truncate(len(text[: text.rfind("\n") + 1].encode()))  # a line that a killed process did not end was not acted on
            attempt.note(facts | {"manifest": manifest_sha256, "pid": os.getpid()})
        except BlockingIOError:
            file.close()
            raise NotAllowed(Refusal.RUNNING, f"session {slot.position} of this plan runs in another process of this tablet") from None
        except BaseException:
            file.close()
            raise
        _sync_folder(self.folder)
        self._replace(_LATEST, max(now, self._latest() or now).isoformat().encode())
        return attempt

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


@dataclass(frozen=True)
class Attempt:
    """An attempt at a slot that runs: its number, from 1, and the slot's file, locked until the end."""

    number: int
    file: TextIOWrapper

    def decide(self, now: datetime) -> None:
        """Note that the policy or schedule decides from now on: the slot is used."""
        self.note({"decided": now.isoformat(timespec="seconds")})

    def end(self, now: datetime, how: str, decisions: int) -> None:
        """Note how the attempt ended, and let the file go."""
        with self.file:
            self.note({"ended": now.isoformat(timespec="seconds"), "how": how, "decisions": decisions})

    def note(self, facts: dict[str, Any]) -> None:
        """Add a line, and wait until it is on the disk."""
        self.file.write(json.dumps(facts) + "\n")
        self.file.flush()
        os.fsync(self.file.fileno())


def _attempts(text: str) -> list[dict[str, Any]]:
    """Read the attempts at a slot. A last line without its end does not count. Any other line that cannot be read uses the slot."""
    found: list[dict[str, Any]] = []
    for line in text.splitlines()[: text.count("\n")]:
        try:
            facts = dict(json.loads(line))
        except (ValueError, TypeError):
            facts = {"decided": None}
        if "began" in facts or not found:
            found.append({})
        found[-1] |= facts
    return found


def _check_free(slot: Slot, attempts: list[dict[str, Any]]) -> None:
    """Raise NotAllowed where an attempt has used the slot. One that names no number is of an older runner, and used it when it began."""
    for notes in attempts:
        if "decided" in notes or "attempt" not in notes:
            raise _refusal_of_use(slot, notes)


def _refusal_of_use(slot: Slot, notes: dict[str, Any]) -> NotAllowed:
    """Describe the attempt that used a slot."""
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
