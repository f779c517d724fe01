"""Cost of the audit trail's hash chain per write, and time to verify it and to compare rows with it.

    python benchmarks/audit_chain.py [--quick]

One row per transaction, and a thousand in one, on an embedded PostgreSQL of this run with fsync on, with the trigger of the chain on and
off in turns. Times are milliseconds of wall time per write, median over rounds.
"""

from __future__ import annotations

import argparse
import json
import os
import tempfile
import time
from pathlib import Path
from statistics import median

from sqlalchemy import create_engine, text
from sqlalchemy.orm import Session
from support.results import run_benchmark


def per_write_ms(db, rows: int, together: bool) -> float:  # type: ignore[no-untyped-def]
    """Measure the time of a row of the trail, ms."""
    begun = time.perf_counter()
    for i in range(rows):
        db.execute(
            text(
                "insert into audit_event (actor, action, entity, entity_id, after) values ('a', 'export', 'session', :i, '{\"rating\": 7}')"
            ),
            {"i": str(i)},
        )
        if not together:
            db.commit()
    db.commit()
    return 1000 * (time.perf_counter() - begun) / rows


def main() -> None:
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--quick", action="store_true", help="fewer rounds")
    rounds = 3 if options.parse_args().quick else 15
    with tempfile.TemporaryDirectory(dir="/tmp") as folder:
        Path(folder).chmod(0o711)
        os.environ["BETALOOP_DATA_DIR"] = folder
        os.environ.pop("BETALOOP_DATABASE_URL", None)
        from app.platform.audit.chain import verify
        from app.platform.audit.guards import past_the_trail
        from app.platform.database import owner_url
        from app.platform.upkeep.migrate import migrate

        migrate()
        found: dict[tuple[bool, bool], list[float]] = {}
        with Session(create_engine(owner_url())) as db:  # the service's role may neither write the trail nor switch a trigger off
            for _ in range(rounds):
                for chained in (True, False):
                    db.execute(text(f"alter table audit_event {'enable' if chained else 'disable'} trigger chained"))
                    db.commit()
                    for together in (False, True):
                        found.setdefault((chained, together), []).append(per_write_ms(db, 1000 if together else 100, together))
            db.execute(text("alter table audit_event enable trigger chained"))
            db.commit()
            begun = time.process_time()
            links = verify(db).links
            verified = time.process_time() - begun
            # two entries of each of many rows of one table, as a study of years may have of its outcomes
            db.execute(text("insert into study (code, name) select 's' || n, 'x' from generate_series(1, :n) n"), {"n": 5000 * rounds})
            db.execute(text("update study set name = 'y' where code <> 'main'"))
            db.commit()
            begun = time.perf_counter()
            assert list(past_the_trail(db)) == []
            held = time.perf_counter() - begun
    cost = {name: median(found[True, t]) - median(found[False, t]) for name, t in (("own_commit", False), ("together", True))}
    for name, t in (("a commit each", False), ("a thousand in one", True)):
        print(f"{name}: {median(found[False, t]):.3f} ms without the chain, {median(found[True, t]):.3f} ms with it")
    took = {"verify_s_per_100000_links": round(1e5 * verified / links, 1), "held_s_per_100000_rows": round(1e5 * held / (5000 * rounds), 1)}
    print(json.dumps({f"cost_ms_{k}": round(v, 3) for k, v in cost.items()} | took))


if __name__ == "__main__":
    run_benchmark(main)
