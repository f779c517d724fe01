"""What a study of a thousand participants costs the database and the pages that look across it, in seconds of the processor.

    python -m benchmarks.development.many_participants            1 000 participants x 3 visits x 4 sessions x 4 policies, with a trail
    python -m benchmarks.development.many_participants --quick    50 participants

One participant is made through the models, as for `benchmarks/pages.py`; all others are its rows, copied by SQL with numbers and codes of
their own. Then a job is asked for of every participant, as a night of re-ranking does, and each page is read five times. Figures are
seconds of the processor, of the service (this process) and of PostgreSQL (its processes, from /proc), which other work on the machine
changes little; median over the reads of a page after its first.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import tempfile
import time
from collections.abc import Collection
from pathlib import Path
from statistics import median
from typing import Any

from fastapi.testclient import TestClient
from sqlalchemy import Computed, Integer, Table, create_engine, text
from sqlalchemy.orm import Session

from app.accounts import service as accounts
from app.accounts.permissions import SYSTEM
from app.main import create_app
from app.pipeline.service import start_job
from app.platform.database import Base, owner_url, transaction
from app.platform.migrate import migrate
from app.settings import get_settings
from app.study import repository
from benchmarks.support.large_study.rows import EMAIL, Extent, add_account, add_participant

PAGES = {
    "today": "/",
    "today, last page": "/?offset={last}",
    "search": "/search?q=P05",
    "participants (REST)": "/api/v1/participants?limit=100",
    "participant": "/participants/{code}",
    "ranking": "/participants/{code}/ranking",
    "queue": "/jobs",
    "audit": "/audit",
    "audit of one row": "/audit?entity=qoc&entity_id=1",
    "audit of one": "/audit?participant={code}",
    "audit, rare word": "/audit?words=zebra",
    "all participants": "/analyses",
}
TRAIL_ROWS = 400
READS = 5


def copy(db: Session, participants: int) -> dict[str, int]:
    """Copy everything of the first participant, the triggers being off; returns rows by table."""
    tables = _of_participants()
    span = {t.name: (db.scalar(text(f'select max(id) from "{t.name}"')) or 0) for t in tables if _numbered(t)}
    for table in tables:
        db.execute(text(f'alter table "{table.name}" disable trigger user'))
        columns = [c for c in table.columns if not isinstance(c.computed, Computed)]
        names = ", ".join(f'"{c.name}"' for c in columns)
        values = ", ".join(_copied(c, span) for c in columns)
        db.execute(
            text(f'insert into "{table.name}" ({names}) select {values} from "{table.name}" t, generate_series(1, :more) k'),
            {"more": participants - 1},
        )
        db.execute(text(f'alter table "{table.name}" enable trigger user'))
        if _numbered(table):
            db.execute(text(f"select setval(pg_get_serial_sequence('{table.name}', 'id'), (select max(id) from \"{table.name}\") + 1)"))
    rows = {t.name: db.scalar(text(f'select count(*) from "{t.name}"')) or 0 for t in tables}
    db.execute(text("alter table audit_event disable trigger user"))
    db.execute(
        text(
            "insert into audit_event (actor, action, entity, entity_id, after)"
            " select 'bench', 'insert', 'qoc', q.id::text, jsonb_build_object('id', q.id, 'session_id', q.session_id, 'rating', q.rating)"
            " from generate_series(1, :each) k, qoc q where q.id <= :most"
        ),
        {"each": max(1, TRAIL_ROWS * participants // max(rows["qoc"], 1)), "most": rows["qoc"]},
    )
    db.execute(text("alter table audit_event enable trigger user"))
    rows["audit_event"] = db.scalar(text("select count(*) from audit_event")) or 0
    db.commit()
    return rows


def _of_participants() -> list[Table]:
    """Tables whose rows belong to a participant, parents first."""
    found = {"participant"}
    for _ in range(10):
        found |= {t.name for t in Base.metadata.sorted_tables if any(k.column.table.name in found for k in t.foreign_keys)}
    return [t for t in Base.metadata.sorted_tables if t.name in found]


def _numbered(table: Table) -> bool:
    return "id" in table.c and isinstance(table.c.id.type, Integer)


def _copied(column: Any, span: dict[str, int]) -> str:
    """The value of a column in copy k, as SQL."""
    name, table = column.name, column.table.name
    if (table, name) == ("participant", "code"):
        return "'P' || lpad((k + 1)::text, 4, '0')"
    parents = {key.column.table.name for key in column.foreign_keys}
    own = {table} if name == "id" else set()
    if "job" in parents or (own and table == "job"):
        return f"md5(t.\"{name}\" || '/' || k)::uuid::text"
    for parent in (*own, *parents):
        if parent in span:
            return f't."{name}" + k * {span[parent]}'
    return f't."{name}"'


def ask_for_jobs(participants: int) -> float:
    """A job of every participant, a transaction each; seconds of the processor of this process for one."""
    with transaction("bench") as db:
        people, _ = repository.participants(db, SYSTEM, participants, 0)
        codes = [p.code for p in people]
    begun = time.process_time()
    for code in codes:
        with transaction("bench") as db:
            start_job(db, repository.participant_by_code(db, code, SYSTEM), "evaluate", {"preset": "quick"}, SYSTEM)
    return (time.process_time() - begun) / len(codes)


def postgres_s() -> float:
    """Seconds that the processes of PostgreSQL have used."""
    with transaction("bench") as db:
        backend = int(db.scalar(text("select pg_backend_pid()")) or 0)
    ticks, clock = 0, os.sysconf("SC_CLK_TCK")
    parent = _stat(backend)[1]
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal() and (found := _stat(int(entry.name))) and found[1] == parent:
            ticks += found[11] + found[12]
    return ticks / clock


def _stat(pid: int) -> list[int]:
    """State (as 0), parent, ..., user and system ticks of a process; empty where it is gone."""
    try:
        fields = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()
    except (FileNotFoundError, ProcessLookupError):
        return []
    return [0, *(int(f) for f in fields[1:20])]


def read_pages(participants: int, names: Collection[str] = tuple(PAGES)) -> dict[str, dict[str, float]]:
    """Seconds of service and database for each page, and its bytes."""
    with transaction("bench") as db:
        token = accounts.create_token(db, EMAIL, f"bench {len(names)}")
    found: dict[str, dict[str, float]] = {}
    headers = {"Authorization": f"Bearer {token}", "Accept": "text/html"}
    with TestClient(create_app(), headers=headers) as client:
        for name in names:
            path = PAGES[name]
            service, database, size = [], [], 0
            for i in range(READS):
                place = {"code": f"P{min(participants, 2 + 7 * i):04d}", "last": max(0, participants - 50)}
                before, begun = postgres_s(), time.process_time()
                answer = client.get(path.format(**place))
                service.append(time.process_time() - begun)
                database.append(postgres_s() - before)
                if answer.status_code != 200:
                    raise SystemExit(f"{path} answered {answer.status_code}: {answer.text[:300]}")
                size = len(answer.content)
            found[name] = {
                "service_s": round(median(service[1:]), 3),
                "database_s": round(median(database[1:]), 3),
                "kb": round(size / 1000),
            }
            print(f"{name:<22}{found[name]['service_s']:>9.3f}{found[name]['database_s']:>9.3f}{found[name]['kb']:>8.0f}", flush=True)
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="50 participants")
    parser.add_argument("--participants", type=int, default=1000)
    options = parser.parse_args()
    participants = 50 if options.quick else options.participants
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        Path(folder).chmod(0o711)
        os.environ["BETALOOP_DATA_DIR"] = folder
        os.environ.pop("BETALOOP_DATABASE_URL", None)
        get_settings.cache_clear()
        migrate()
        with transaction("bench") as db:
            add_account(db)
            add_participant(db, 1, Extent(1, 3, 4, 4))
        begun = time.monotonic()
        with Session(create_engine(owner_url())) as db:
            rows = copy(db, participants)
            db.execute(text("analyze"))
            size = db.scalar(text("select pg_database_size(current_database())")) or 0
            db.commit()
        print(f"copied in {time.monotonic() - begun:.0f} s: {json.dumps(rows)}; {size / 1e9:.2f} GB", file=sys.stderr, flush=True)
        print(f"{'page':<22}{'service s':>9}{'postgres s':>9}{'kB':>8}")
        before = read_pages(participants)
        per_job = ask_for_jobs(participants)
        print(f"a job asked for: {per_job:.3f} s; the same pages with {participants} jobs waiting:")
        after = read_pages(participants, ("today", "queue"))
        print(
            json.dumps(
                {"participants": participants, "gb": round(size / 1e9, 2), "job_s": round(per_job, 4), "pages": before, "waiting": after}
            )
        )


if __name__ == "__main__":
    main()
