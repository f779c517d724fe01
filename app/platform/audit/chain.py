"""Hashes that chain the audit trail, and seals of the chain with a key that no SQL can read.

A trigger at the end of each transaction gives every row of the trail a link. The link has its place and a SHA-256 over the digest of the
link before and the row. An edit, a gap, an inserted row or links in another order break it. The owner of the tables could compute the whole
chain again, or cut off its end. So seals record the digest at a place under an HMAC. Its key is in the data folder; the seals are in the
database and in a file of that folder.
"""

from __future__ import annotations

import hashlib
import hmac
import json
import os
import threading
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice
from pathlib import Path

import structlog
from sqlalchemy import select, text
from sqlalchemy.dialects.postgresql import insert
from sqlalchemy.exc import SQLAlchemyError
from sqlalchemy.orm import Session

from app.platform.audit.breaks import MOST_BREAKS, Accepted, Break, BreakKind, acceptances
from app.platform.audit.guards import past_the_trail, what_writes
from app.platform.audit.signatures import changed_records
from app.platform.database import transaction
from app.settings import get_settings, private_folder
from app.tables.audit import GENESIS, AuditLink, AuditSeal

SECRET = "audit-seals"  # noqa: S105 - the name of a key
SEAL_EVERY_S = 60.0
_A_DAY_US = 86_400_000_000
"""How far the times of links may go back, microseconds: a link is made when its transaction ends, and a transaction may last."""


@dataclass(frozen=True)
class Verified:
    """Findings of a check of the whole trail.

    Attributes:
        links: how long the chain is. seals: how many seals were compared with it. sealed_to: the last sealed place; 0 where there is none.
        breaks: in the order of their places, at most MOST_BREAKS. accepted: false times that a person has looked into; they are no breaks.
    """

    links: int
    seals: int
    sealed_to: int
    breaks: tuple[Break, ...]
    accepted: tuple[Accepted, ...] = ()

    @property
    def whole(self) -> bool:
        """True where nothing is broken."""
        return not self.breaks


def digest_of(previous: bytes, fields: Sequence[str | None]) -> bytes:
    """Compute the digest of a link: SHA-256 over the digest before it and the row's fields, each with its length (-1 where null)."""
    found = hashlib.sha256(previous)
    for field in fields:
        raw = b"" if field is None else field.encode()
        found.update((-1 if field is None else len(raw)).to_bytes(4, "big", signed=True) + raw)
    return found.digest()


def seal(db: Session) -> int:
    """Seal the chain at its end, in the database and in a file of the data folder; returns the place. The caller commits.

    A chain that ends at its last seal is not sealed again.
    """
    last = db.scalars(select(AuditLink).order_by(AuditLink.position.desc()).limit(1)).first()
    if last is None or db.get(AuditSeal, last.position) is not None:
        return last.position if last else 0
    mac = _mac(last.position, last.digest)
    row = insert(AuditSeal).values(position=last.position, digest=last.digest, mac=mac)
    db.execute(row.on_conflict_do_nothing())  # another process of the service may seal the same place
    _write_line({"position": last.position, "digest": last.digest.hex(), "mac": mac.hex()})
    return last.position


def keep_sealing(stop: threading.Event) -> None:
    """Seal the chain whenever it has grown, once a minute, until `stop` is set."""
    log, told = structlog.get_logger(), False
    while not stop.wait(SEAL_EVERY_S):
        try:
            with transaction("the service") as db:
                seal(db)
            told = False
        except (SQLAlchemyError, OSError) as error:
            if not told:
                log.error("the audit trail cannot be sealed", error=type(error).__name__)
            told = True


def verify(db: Session) -> Verified:
    """Verify the trail: compute the whole chain again, compare every seal with it, and check what writes it and the rows that it covers."""
    digests: dict[int, bytes] = {}
    wanted = [*_seals_of_database(db), *_seals_of_file()]
    places = {place for place, _, _ in wanted}
    breaks, links, before, latest = [], 0, GENESIS, 0
    known, accepted = acceptances(db), []
    for position, event_id, stored, fields in _links(db):
        links += 1
        if position != links:
            breaks.append(Break(BreakKind.GAP, links))
            links = position
        if fields is None:
            breaks.append(Break(BreakKind.REMOVED, position, event_id))
        elif digest_of(before, fields) != stored:
            breaks.append(Break(BreakKind.EDITED, position, event_id))
        moment = latest if fields is None else int(fields[1] or 0)
        if moment < latest - _A_DAY_US:
            found = Break(BreakKind.BACKDATED, position, event_id)
            if (looked_into := known.get(event_id)) is None:
                breaks.append(found)
            else:
                accepted.append(Accepted(found, looked_into.actor, looked_into.at, looked_into.reason or ""))
            latest = moment  # those that follow at the same time are not named again: the rest of the chain is looked at
        latest = max(latest, moment)
        before = stored
        if position in places:
            digests[position] = stored
        if len(breaks) >= MOST_BREAKS:
            break
    if len(breaks) < MOST_BREAKS:
        breaks += [Break(BreakKind.ADDED, event_id=i) for i in _unlinked(db)]
        breaks += _against_seals(wanted, digests, links)
        breaks += what_writes(db)
        breaks += [Break(BreakKind.SIGNATURE_CHANGED, table="signature", row=str(i)) for i in changed_records(db)]
        breaks += islice(past_the_trail(db), MOST_BREAKS)
    return Verified(links, len(places), max(places, default=0), tuple(breaks[:MOST_BREAKS]), tuple(accepted))


def _against_seals(wanted: Sequence[tuple[int, bytes, bytes]], digests: dict[int, bytes], links: int) -> list[Break]:
    found = []
    for position, digest, mac in sorted(set(wanted)):
        if not hmac.compare_digest(mac, _mac(position, digest)):
            found.append(Break(BreakKind.FORGED_SEAL, position))
        elif position > links:
            found.append(Break(BreakKind.CUT_OFF, position))
        elif digests.get(position) != digest:
            found.append(Break(BreakKind.REWRITTEN, position))
    return found


def _links(db: Session) -> Iterator[tuple[int, int, bytes, list[str | None] | None]]:
    """Yield every link in order: its place, row, digest, and the row's fields as text; None where the row is gone."""
    rows = db.execute(
        text(
            "select l.position, l.event_id, l.digest, e.id::text, (extract(epoch from e.at) * 1000000)::bigint::text, e.actor,"
            " e.user_id::text, e.request_id, e.action, e.entity, e.entity_id, e.before::text, e.after::text, e.reason"
            " from audit_link l left join audit_event e on e.id = l.event_id order by l.position"
        ).execution_options(yield_per=1000)
    )
    for position, event_id, digest, *fields in rows:
        yield position, event_id, bytes(digest), None if fields[0] is None else list(fields)


def _unlinked(db: Session) -> list[int]:
    """Find rows of the trail without a link: inserted while the trigger was off."""
    statement = (
        "select e.id from audit_event e left join audit_link l on l.event_id = e.id where l.event_id is null order by e.id limit :most"
    )
    return list(db.scalars(text(statement), {"most": MOST_BREAKS}))


def _seals_of_database(db: Session) -> list[tuple[int, bytes, bytes]]:
    return [(s.position, s.digest, s.mac) for s in db.scalars(select(AuditSeal).order_by(AuditSeal.position))]


def _seals_of_file() -> list[tuple[int, bytes, bytes]]:
    """Read the seals of the file; a line that was cut by a crash while it was written is none."""
    found = []
    path = _file()
    for line in path.read_text().splitlines() if path.exists() else ():
        try:
            said = json.loads(line)
            found.append((int(said["position"]), bytes.fromhex(said["digest"]), bytes.fromhex(said["mac"])))
        except (ValueError, KeyError, TypeError):
            continue
    return found


def _mac(position: int, digest: bytes) -> bytes:
    return hmac.new(get_settings().secret(SECRET), position.to_bytes(8, "big") + digest, hashlib.sha256).digest()


def _file() -> Path:
    """Locate the file of seals, out of the reach of SQL."""
    return private_folder(get_settings().data_dir / "audit") / "seals.jsonl"


def _write_line(said: dict[str, object]) -> None:
    with open(os.open(_file(), os.O_WRONLY | os.O_CREAT | os.O_APPEND, 0o600), "ab", buffering=0) as out:
        out.write(json.dumps(said).encode() + b"\n")
        os.fsync(out.fileno())
