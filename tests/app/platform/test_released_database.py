"""A database that release 0.1.0 filled: it migrates to the present schema, and every page and every route that reads still answers.

The dump holds what `betaloop demo` of 0.1.0 made, and some things done by hand: a bundle taken, a plan approved, sessions of its policies,
proposals, a quarantine, a cancelled job. Its people are the demo's, its passwords were drawn for it, and its files are the small ones
(distilled policies, snapshots); bytes of uploads and of large policies are not among them.
"""

from __future__ import annotations

import lzma
import re
from collections.abc import Iterator
from itertools import product
from typing import Any

import psycopg
import pytest
from fastapi.routing import iter_route_contexts
from fastapi.testclient import TestClient
from sqlalchemy import text

import app.platform.database as database
from app.accounts import repository as accounts_repository
from app.accounts import service as accounts
from app.analysis.energy.schemas import ImplantIn
from app.platform.audit.chain import verify
from app.platform.database import Base
from app.platform.files import path_of
from app.platform.tables import load_tables
from tests.conftest import RELEASED_DUMP

PERSON = "admin@demo.example"
PASSWORD = "a password of the test"

# rows to open, by each part of a path; policies are those whose files are kept
IDS = {
    "code": "select code from participant where code in ('P1', 'P4')",
    "visit_id": "select v.id from visit v join participant p on p.id = v.participant_id where p.code in ('P1', 'P4')",
    "session_id": "select min(s.id) from session s group by s.visit_id, s.status, s.controller",
    "upload_id": "select min(upload_id) from upload_file group by kind, status",
    "file_id": "select min(id) from upload_file group by status",
    "policy_id": "select min(id) from policy where participant_id = 1 and kind in ('trained', 'distilled') group by kind union "
    "select max(id) from policy where participant_id = 1 and kind = 'baseline'",
    "snapshot_id": "select id from buffer_snapshot",
    "sweep_id": "select id from sweep",
    "job_id": "select id::text from job",
    "position": "select min(position) from plan_item",
    "study_code": "select code from study",
    "site_code": "select code from site",
    "key": "select 'random'",  # a word for a comparison
}

# tables of the release have no preview, so that none of them waits for a column mapping
PREVIEWS = {"/api/v1/uploaded-files/{file_id}/preview", "/uploaded-files/{file_id}/mapping"}
# what has no such record yet, and says so with 404: (route, rows)
ABSENT = {
    "/api/v1/participants/{code}/ranking": "select code from participant where id not in (select participant_id from evaluation)",
    "/participants/{code}/ranking.csv": "select code from participant where id not in (select participant_id from evaluation)",
    "/api/v1/participants/{code}/replay": "select code from participant where code <> 'P1'",
    "/participants/{code}/compare": "select code from participant where code <> 'P1'",
    "/api/v1/visits/{visit_id}/plan": "select id from visit where id not in (select visit_id from plan)",
    "/api/v1/visits/{visit_id}/plan.pdf": "select id from visit where id not in (select visit_id from plan)",
    **dict.fromkeys(
        (
            "/api/v1/visits/{visit_id}/day",
            "/api/v1/visits/{visit_id}/slots",
            "/api/v1/visits/{visit_id}/plan/sessions/{position}/bundle",
            "/visits/{visit_id}/slots",
            "/visits/{visit_id}/bundles",
            "/visit-day/{visit_id}",
        ),
        "select id from visit where id not in (select visit_id from plan)",
    ),
    **dict.fromkeys(PREVIEWS, "select id from upload_file"),
    "/api/v1/proposals/{session_id}": "select id from session where status <> 'proposed'",
    "/proposals/{session_id}": "select id from session where status <> 'proposed'",
}
# what a route needs to be told besides its path: a session and a policy of P1; the stated implant
QUERIES = {"/api/v1/participants/{code}/analyses/battery": f"select '{'&'.join(f'{name}=1' for name in ImplantIn.model_fields)}'"}
QUERIES |= dict.fromkeys(
    ("/api/v1/participants/{code}/replay", "/participants/{code}/compare"),
    "select 'session=' || min(s.id) || '&policy=' || min(p.id) from session s"
    " join visit v on v.id = s.visit_id join policy p on p.participant_id = v.participant_id"
    " where v.participant_id = 1 and s.status = 'confirmed' and p.kind = 'trained'",
)
# a proposed session is shown by its own page: (route, rows that are sent elsewhere)
ELSEWHERE = {"/sessions/{session_id}": "select id from session where status = 'proposed'"}
# plans of the release were approved without a signature, and what needs one says so
UNSIGNED = {"/api/v1/visits/{visit_id}/plan/sessions/{position}/bundle"}
# what is read from uploaded files, of which only small ones are kept here: the answer is 409 where a session's are not
FROM_FILES = {"/api/v1/sessions/{session_id}/samples"}
# samples for the screen: the sessions whose files are kept are tables of steps
NO_SAMPLES = {"/api/v1/sessions/{session_id}/signal", "/sessions/{session_id}/signal", "/sessions/{session_id}/signal.json"}
FILES = (
    "select g.session_id, f.stored_sha256 from session_segment g join recording r on r.id = g.recording_id"
    " join upload_file f on f.id = r.upload_file_id"
)
# pages for who is not signed in
SIGNED_OUT = {"/sign-in"}


def rows(query: str) -> list[Any]:
    """The first column of a query's rows."""
    with database.new_session() as db:
        return sorted(db.scalars(text(query)))


def without_files() -> set[int]:
    """Sessions of which an uploaded file is not kept."""
    with database.new_session() as db:
        return {session for session, sha256 in db.execute(text(FILES)) if not path_of(sha256).exists()}


def readable(app: Any) -> set[str]:
    """Paths of every route that answers GET, pages and interface, but those of files."""
    found = {c.path for c in iter_route_contexts(app.routes) if c.path and "GET" in (getattr(c, "methods", None) or ())}
    elsewhere = {path for path in found if path.startswith("/sign-on")}  # lead to a hospital's sign-on, where there is one
    return {path for path in found - elsewhere if not path.endswith(":path}") and path != "/styleguide"}  # of development alone


def calls(path: str, ids: dict[str, list[Any]]) -> Iterator[dict[str, Any]]:
    """Every combination of rows that a path's parts can name and that belong together."""
    names = re.findall(r"{(\w+)}", path)
    unknown = set(names) - set(IDS)
    assert not unknown, f"{path}: say in IDS which rows to open for {sorted(unknown)}"
    for values in product(*(ids[name] for name in names)):
        chosen = dict(zip(names, values, strict=True))
        if "policy_id" in chosen and "code" in chosen and chosen["code"] != "P1":
            continue  # all policies of IDS are P1's
        yield chosen


def opened(client: TestClient, path: str, values: dict[str, Any]) -> int:
    """Status of a GET; an event stream is read to its first bytes."""
    url = path.format(**values) + (f"?{rows(QUERIES[path])[0]}" if path in QUERIES else "")
    with client.stream("GET", url, follow_redirects=False) as answer:
        if "text/event-stream" not in answer.headers.get("content-type", ""):
            answer.read()
        return answer.status_code


def unexpected(client: TestClient, paths: set[str]) -> dict[str, int]:
    """Addresses whose answer is not the one it should be."""
    ids = {name: rows(query) for name, query in IDS.items()}
    assert all(ids.values()), "the dump has rows of every kind"
    found = {}
    gone = without_files()
    for path in sorted(paths):
        absent, elsewhere = (rows(table[path]) if path in table else [] for table in (ABSENT, ELSEWHERE))
        rights = set()
        for values in calls(path, ids):
            row = next(iter(values.values()), None)
            right = 404 if row in absent else 303 if row in elsewhere or path in SIGNED_OUT else 200
            if (path in NO_SAMPLES and right == 200) or (path in FROM_FILES and row in gone) or (path in UNSIGNED and right == 200):
                right = 409
            rights.add(right)
            status = opened(client, path, values)
            if status != right:
                found[f"{path.format(**values)} (not {right})"] = status
        if 200 not in rights and path not in SIGNED_OUT | FROM_FILES | NO_SAMPLES | UNSIGNED | PREVIEWS:
            found[f"{path}: no row of IDS can be opened"] = 404
    return found


def test_every_table_of_the_release_has_rows(released_database: str) -> None:
    load_tables()
    with psycopg.connect(released_database.replace("+psycopg", "")) as connection:
        dumped = set(re.findall(r"^CREATE TABLE public\.(\w+)", lzma.decompress(RELEASED_DUMP.read_bytes()).decode(), re.MULTILINE))
        empty = {t for t in dumped & set(Base.metadata.tables) if not connection.execute(f"select 1 from {t} limit 1").fetchone()}
    assert empty == set()


def test_every_page_of_a_released_study_opens(released_database: str, application: Any) -> None:
    pages = {path for path in readable(application) if not path.startswith("/api/")}
    with TestClient(application, base_url="http://testserver") as client:
        with database.transaction("test") as db:
            person = accounts_repository.user_by_email(db, PERSON)
            assert person is not None
            accounts.set_password(db, person, PASSWORD)
        signed_in = client.post("/sign-in", data={"email": PERSON, "password": PASSWORD}, follow_redirects=False)
        assert signed_in.status_code == 303
        assert unexpected(client, pages) == {}


@pytest.mark.slow
def test_every_route_of_the_interface_reads_a_released_study(released_database: str, application: Any) -> None:
    with database.transaction("test") as db:
        token = accounts.create_token(db, PERSON, "tests")
    with TestClient(application, headers={"Authorization": f"Bearer {token}"}) as client:
        assert unexpected(client, {path for path in readable(application) if path.startswith("/api/")}) == {}


def test_the_trail_of_the_release_is_whole_after_the_upgrade(released_database: str) -> None:
    """What the upgrade chains and seals, and the rows that no trigger saw, stand as the release left them."""
    with database.new_session() as db:
        found = verify(db)
    assert found.breaks == ()
    assert found.links > 1000


def test_tokens_of_the_release_end_ninety_days_after_the_upgrade(released_database: str) -> None:
    """They had no end."""
    url = released_database.replace("+psycopg", "")
    with psycopg.connect(url) as connection:
        left = connection.execute("select extract(epoch from expires_at - now()) / 86400 from api_token").fetchall()
        reasons = connection.execute("select reason from audit_event where entity = 'api_token' and action = 'update'").fetchall()
    assert left
    assert all(89 < days <= 90 for (days,) in left)
    assert reasons.count(("tokens have an end; one without ends 90 days from this upgrade",)) == len(left)
    with psycopg.connect(url) as connection, pytest.raises(psycopg.errors.NotNullViolation):
        connection.execute("update api_token set expires_at = null")
