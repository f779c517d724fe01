"""The session slot that a bundle is for, and whether it may run now: on its day, once, while nothing of it has been withdrawn.

The content of a blinded slot is masked, and padded to one size for all sessions of a plan. That keeps people from learning by looking, and
no more. The tablet must run the content, so a person who writes a program can read it.
"""

from __future__ import annotations

import hashlib
import json
import struct
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date, datetime
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from .signature import verifies

SEALED = "session.bin"
"""The file of a blinded bundle that holds manifest, test vectors, and network or schedule."""


class Refusal(StrEnum):
    """Reason why a bundle does not run."""

    NO_SLOT = "no_slot"
    NOT_SIGNED = "not_signed"
    OTHER_PARTICIPANT = "other_participant"
    TOO_EARLY = "too_early"
    EXPIRED = "expired"
    CLOCK = "clock"
    WITHDRAWN = "withdrawn"
    ALREADY_RUN = "already_run"
    BROKEN_OFF = "broken_off"
    RUNNING = "running"
    OTHER_DEVICE = "other_device"


class NotAllowed(ValueError):
    """The bundle does not run. `code` says why, the message in words for the person at the tablet."""

    def __init__(self, code: Refusal, message: str) -> None:
        super().__init__(message)
        self.code = code


@dataclass(frozen=True, kw_only=True)
class Slot:
    """One session of a signed visit plan.

    Attributes:
        plan_id, slot_id: as the study numbers the plan and its session. position: of the session in the visit, from 1.
        visit_number, visit_date: the visit, and its day as an ISO 8601 date: the only one on which the bundle runs.
        controller: what runs, as the study names it (`rl`, `distilled`, `random`, `cdbs`, `no_dbs`, `other`).
        minutes: length of the session, after the window before it.
        plan_sha256: of what was signed. issued_at: when the bundle was made, ISO 8601 with its offset.
        label: of a blinded plan; None where it has none. repeat: which session of this controller in the visit, from 1.

    Raises:
        ValueError: a date or time that is none, or no minutes.
    """

    plan_id: int
    slot_id: int
    position: int
    visit_number: int
    visit_date: str
    controller: str
    minutes: float
    plan_sha256: str
    issued_at: str
    label: str | None = None
    repeat: int = 1

    def __post_init__(self) -> None:
        date.fromisoformat(self.visit_date)
        if datetime.fromisoformat(self.issued_at).tzinfo is None:
            raise ValueError(f"issued_at needs an offset from UTC, not {self.issued_at}")
        if not 0 < self.minutes <= 240:
            raise ValueError(f"a session lasts more than 0 and at most 240 minutes, not {self.minutes}")

    def check_day(self, now: datetime) -> None:
        """Raise NotAllowed on any other day than the visit's, by the tablet's own date.

        Args:
            now: the tablet's local time, with its offset.
        """
        issued = datetime.fromisoformat(self.issued_at)
        if now < issued:
            raise NotAllowed(
                Refusal.CLOCK,
                f"the tablet's clock says {now:%Y-%m-%d %H:%M}, and the bundle was made at {issued.astimezone(now.tzinfo):%Y-%m-%d %H:%M}: "
                "set the clock",
            )
        today, day = now.date(), date.fromisoformat(self.visit_date)
        if today < day:
            raise NotAllowed(Refusal.TOO_EARLY, f"the bundle is for the visit of {day}; today is {today}")
        if today > day:
            raise NotAllowed(Refusal.EXPIRED, f"the bundle was for the visit of {day} and expired that night; take one of today's plan")


@dataclass(frozen=True)
class Withdrawals:
    """Policies and plans that the study has taken back, signed by it. `issued_at`: ISO 8601; the newest list counts."""

    issued_at: str
    policies: frozenset[int]
    plans: frozenset[int]

    def check(self, slot: Slot, policy_id: int | None) -> None:
        """Raise NotAllowed for a slot of a plan, or with a policy, that was taken back."""
        if policy_id is not None and policy_id in self.policies:
            which = f"policy {policy_id}" if slot.label is None else f"what session {slot.label} was to run"  # a blinded one is not named
            raise NotAllowed(Refusal.WITHDRAWN, f"{which} was withdrawn; have the plan changed and signed again")
        if slot.plan_id in self.plans:
            raise NotAllowed(Refusal.WITHDRAWN, f"plan {slot.plan_id} was replaced or withdrawn; take a bundle of the present plan")


def read_withdrawals(path: Path, public_key: bytes) -> Withdrawals:
    """Read the list in a file: one line of JSON, and its Ed25519 signature in hexadecimal digits in a second one.

    Raises:
        NotAllowed: the file cannot be read, or its signature is not that of the key.
    """
    try:
        body, signature = path.read_bytes().split(b"\n")[:2]
        if not verifies(public_key, body, bytes.fromhex(signature.decode("ascii").strip())):
            raise ValueError("the signature does not belong to the study's key")
        return withdrawals_of(json.loads(body))
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise NotAllowed(Refusal.WITHDRAWN, f"the list of withdrawals {path} cannot be used: {error}") from error


def withdrawals_of(stored: dict[str, Any]) -> Withdrawals:
    """Read withdrawals from JSON. Raises KeyError, TypeError, ValueError for another shape."""
    if stored["kind"] != "betaloop withdrawals":
        raise ValueError("it is no list of withdrawals")
    datetime.fromisoformat(stored["issued_at"])
    return Withdrawals(stored["issued_at"], frozenset(map(int, stored["policies"])), frozenset(map(int, stored["plans"])))


def withdrawals_body(withdrawn: Withdrawals) -> bytes:
    """Write the JSON line that is signed."""
    facts = {"kind": "betaloop withdrawals", "issued_at": withdrawn.issued_at}
    return json.dumps(facts | {"policies": sorted(withdrawn.policies), "plans": sorted(withdrawn.plans)}, sort_keys=True).encode()


def mask(content: bytes, nonce: str, part: str = "") -> bytes:
    """Mask content; masking it again restores it. `nonce`: hexadecimal digits. `part`: of what."""
    stream = hashlib.shake_256(bytes.fromhex(nonce) + part.encode()).digest(len(content))
    return (np.frombuffer(content, dtype=np.uint8) ^ np.frombuffer(stream, dtype=np.uint8)).tobytes()


def seal(files: Mapping[str, bytes], nonce: str, room: int) -> bytes:
    """Seal files in one, filled up to `room` bytes, or to the next power of two where they need more."""
    head = json.dumps([[name, len(content)] for name, content in files.items()]).encode()
    whole = struct.pack(">Q", len(head)) + head + b"".join(files.values())
    while room < len(whole):
        room *= 2
    return mask(whole.ljust(room, b"\0"), nonce)


def unseal(content: bytes, nonce: str) -> dict[str, bytes]:
    """Unpack what `seal` wrote. Raises ValueError for other bytes."""
    plain = mask(content, nonce)
    try:
        (length,) = struct.unpack(">Q", plain[:8])
        at, files = 8 + length, {}
        for name, size in json.loads(plain[8:at]):
            files[str(name)] = plain[at : at + size]
            at += size
    except (struct.error, ValueError, TypeError) as error:
        raise ValueError(f"{SEALED} cannot be read") from error
    if at > len(plain):
        raise ValueError(f"{SEALED} is cut")
    return files


def same_session(outer: Mapping[str, Any], inner: Mapping[str, Any]) -> None:
    """Raise ValueError where what is sealed is of another session than the manifest outside says."""
    told = [(m["participant"], m["cdbs_ma"], m["slot"]["plan_id"], m["slot"]["slot_id"], m["slot"]["visit_date"]) for m in (outer, inner)]
    if told[0] != told[1]:
        raise ValueError("what is sealed is of another session than the manifest says")


def opened(outer: dict[str, Any], content: bytes) -> tuple[dict[str, Any], dict[str, bytes]]:
    """Open the sealed manifest and files of a blinded bundle. Raises ValueError, KeyError, TypeError for other bytes."""
    files = unseal(content, outer["sealed"])
    inner = json.loads(files.pop("manifest.json"))
    same_session(outer, inner)
    return inner, files
