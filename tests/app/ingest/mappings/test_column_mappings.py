"""Tables that no decoder knows: a screened preview, columns that a person names once per study, and later tables read by themselves."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from html import unescape
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import text
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller, Grant
from app.ingest.mappings import rules
from app.ingest.mappings.schemas import MappingIn
from app.ingest.mappings.service import may_remove
from app.platform.errors import Invalid
from app.platform.files import path_of
from app.tables.accounts import Role
from tests.app.ingest.conftest import Send

API, PAGE = "/api/v1", {"Accept": "text/html"}
T0_MS = 1_772_445_600_000
"""2026-03-02 10:00:00 UTC, the day of visit 1."""


def strange(rows: int = 20, begin_ms: int = T0_MS, beta: float = 1.0, title: str = "Export of the clinic's system") -> bytes:
    """Write steps as a program of a clinic does: a title, its own names, a line of units, Unix milliseconds, decimal commas."""
    head = f"{title}\n\nZeit;Signal links;Signal rechts;Strom links;Strom rechts;Kommentar\nms;µV;µV;mA;mA;\n"
    cells = [(begin_ms + 2000 * k, beta + k / 10, beta + 1 + k / 10, 1.5, 2.5, "gut") for k in range(rows)]
    return (head + "".join(";".join(map(str, row)).replace(".", ",") + "\n" for row in cells)).encode("latin-1")


def columns(*roles: tuple[Any, ...]) -> list[dict[str, Any]]:
    names = ("number", "role", "unit", "side", "channel")
    return [dict(zip(names, given, strict=False)) for given in roles]


STEPS: dict[str, Any] = {
    "name": "Clinic's system",
    "header_line": 3,
    "unit_lines": 1,
    "holds": "steps",
    "time_format": "unix_ms",
    "time_at": "end",
    "columns": columns(
        (1, "time"),
        (2, "beta", "uV", "left", "0-2"),
        (3, "beta", "uV", "right"),
        (4, "amplitude_ma", "mA", "left"),
        (5, "amplitude_ma", "mA", "right"),
    ),
}


@pytest.fixture
def waiting(send: Send) -> int:
    """The number of a strange table that waits."""
    return wait(send, strange())


def wait(send: Send, content: bytes, name: str = "t.csv") -> int:
    answer = send((name, content), visit=1)
    assert answer.status_code == 422, answer.text
    (number,) = answer.json()["waits_for_mapping"]
    return int(number)


def errors(answer: Any) -> list[tuple[str, str]]:
    assert answer.status_code == 422, answer.text
    return [(e["where"], e["what"]) for e in answer.json()["errors"]]


def test_a_table_of_unknown_columns_is_previewed_named_once_and_read_by_itself_from_then_on(
    client: TestClient, send: Send, waiting: int, db: Session
) -> None:
    shown = client.get(f"{API}/uploaded-files/{waiting}/preview").json()
    assert (shown["width"], shown["header_line"], shown["unit_lines"], shown["mapping"]) == (6, 3, 1, None)
    lines = {line["number"]: line["cells"] for line in shown["lines"]}
    assert lines[1] == ["…'…"]
    assert lines[3] == ["Zeit", "Signal links", "Signal rechts", "Strom links", "Strom rechts", "…"]
    assert lines[4] == ["ms", "uV", "uV", "mA", "mA", ""]
    assert lines[5] == ["#############", "1", "2", "1.5", "2.5", "…"]
    assert [line["may_be_header"] for line in shown["lines"]][:2] == [False, True]

    made = client.put(f"{API}/uploaded-files/{waiting}/mapping", json=STEPS)
    assert made.status_code == 200, made.text
    body = made.json()
    assert (body["mapping"]["version"], body["mapping"]["current"], body["waiting"]) == (1, True, [])
    assert body["report"][0]["understood"][0] == "read by the study's column mapping 'Clinic's system', version 1"
    (session,) = body["session_ids"]
    traces = client.get(f"{API}/sessions/{session}/traces").json()
    found = {(t["hemisphere"], t["stream"], t["channel"]): (t["unit"], t["values"][:2]) for t in _flat(traces)}
    assert found[("left", "beta", "0-2")] == ("uV", [1.0, pytest.approx(1.1)])
    assert found[("right", "beta", "table")][1] == [2.0, pytest.approx(2.1)]
    assert found[("left", "amplitude", "amplitude_ma")] == ("mA", [1.5, 1.5])
    assert found[("right", "amplitude", "amplitude_ma")] == ("mA", [2.5, 2.5])
    # a step's time is its end: the first begins 2 s before
    starts = db.scalars(text("select started_at at time zone 'utc' from recording")).all()
    assert [f"{s:%Y-%m-%d %H:%M:%S}" for s in starts] == ["2026-03-02 09:59:58"] * 2
    assert client.get(f"{API}/uploaded-files/{waiting}/preview").status_code == 404, "it waits no more"
    assert db.scalar(text("select quarantine_sha256 from upload_file")) is None, "the encrypted original is gone"

    # later, with another title and of another minute: no question
    later = send(("u.csv", b"Another title\nand a second one\n" + strange(begin_ms=T0_MS + 600_000, beta=4.0)), visit=1)
    assert later.status_code == 201, later.text
    assert "read by the study's column mapping" in later.json()["report"][0]["understood"][0]
    assert later.json()["files"][0]["kind"] == "mapped"
    # the same bytes again change nothing
    assert send(("u.csv", strange()), visit=1).json()["duplicate"] is True


def _flat(traces: Any) -> list[dict[str, Any]]:
    """List every trace of a session with its side."""
    if isinstance(traces, dict):
        traces = traces.get("traces") or traces.get("recordings")
    return [t | {"hemisphere": t.get("hemisphere", r.get("hemisphere"))} for r in traces for t in r.get("traces", [r])]


def test_another_study_is_asked_for_itself(client: TestClient, send: Send, waiting: int) -> None:
    client.put(f"{API}/uploaded-files/{waiting}/mapping", json=STEPS)
    assert client.post(f"{API}/studies", json={"code": "other", "name": "Another study"}).status_code == 201
    person = client.post(f"{API}/participants", json={"code": "other-1", "site": "other"})
    assert person.status_code == 201, person.text
    assert client.post(f"{API}/participants/other-1/visits", json={"number": 1, "date": "2026-03-02"}).status_code == 201
    answer = client.post(f"{API}/uploads", data={"participant": "other-1"}, files=[("file", ("t.csv", strange(beta=9.0)))])
    assert answer.status_code == 422, answer.text
    assert len(answer.json()["waits_for_mapping"]) == 1


@pytest.mark.parametrize(
    ("change", "told"),
    [
        ({"header_line": 1}, ("Line of names", "line 1 is not one of the preview that has all columns")),
        ({"time_format": "dmy"}, ("Zone", "dates need the zone in which they are written, e.g. Europe/Berlin or UTC")),
        ({"zone": "Europe/Berlin"}, ("Zone", "only written dates have a zone: leave it empty")),
        ({"time_format": "samples"}, ("Rate", "numbers of samples need the rate")),
        ({"time_at": None}, ("A step's time", "say whether a step's time stands at its begin or its end")),
        ({"holds": "lfp", "time_at": None}, ("Column 2", "a table of samples of LFP has no column 'Beta, amplitude'")),
        (
            {"columns": columns((1, "time"), (2, "beta", "mA"), (4, "amplitude_ma", "mA"))},
            ("Column 2", "'Beta, amplitude' is in one of uV, nV, mV, V, dB, z, a.u., device units, lsb, counts"),
        ),
        (
            {"columns": columns((1, "time"), (2, "beta", None), (4, "amplitude_ma", "mA"))},
            ("Column 2", "state the unit of 'Beta, amplitude': uV, nV, mV, V, dB, z, a.u., device units, lsb, counts"),
        ),
        (
            {"columns": columns((1, "time"), (2, "beta", "uV", "left"), (4, "amplitude_ma", "mA"))},
            ("Column 4", "state the side, as of the others"),
        ),
        (
            {"columns": columns((1, "time"), (2, "beta", "uV"), (3, "beta", "uV"), (4, "amplitude_ma", "mA"))},
            ("Column 3", "state side and channel, so that no two signals have the same"),
        ),
        (
            {"columns": columns((1, "time"), (2, "beta", "uV", None, "Mrs Miller"), (4, "amplitude_ma", "mA"))},
            ("Column 2", "write the channel as contacts, such as 0-2, E1-E3 or 1A"),
        ),
        (
            {"columns": columns((1, "time"), (2, "beta", "uV"))},
            ("Columns", "a table of steps needs a column of the stimulation's amplitude"),
        ),
        ({"columns": columns((2, "beta", "uV"), (4, "amplitude_ma", "mA"))}, ("Columns", "one column is the time, not 0")),
        ({"columns": columns((1, "time"), (9, "beta", "uV"), (4, "amplitude_ma", "mA"))}, ("Column 9", "the table has 6 columns")),
    ],
)
def test_what_cannot_be_meant_is_told_with_its_field(change: dict[str, Any], told: tuple[str, str]) -> None:
    lines = [{"number": 1, "cells": [""], "header": None}, {"number": 3, "cells": [""] * 6, "header": "a" * 64}]
    with pytest.raises(Invalid) as refused:
        rules.mapping_of(MappingIn(**(STEPS | change)), {"width": 6, "lines": lines})
    assert told in [(e["where"], e["what"]) for e in refused.value.extra["errors"]]


def test_a_mapping_that_does_not_read_the_table_is_refused_with_the_reason_and_nothing_is_lost(
    client: TestClient, waiting: int, db: Session
) -> None:
    before = db.execute(text("select status, quarantine_sha256, report from upload_file")).all()
    answer = client.put(f"{API}/uploaded-files/{waiting}/mapping", json=STEPS | {"time_format": "seconds"})
    assert answer.status_code == 422
    assert "the times are Unix milliseconds" in answer.json()["detail"]
    fields = client.put(f"{API}/uploaded-files/{waiting}/mapping", json=STEPS | {"time_format": "dmy"})
    assert ("Zone", "dates need the zone in which they are written, e.g. Europe/Berlin or UTC") in errors(fields)
    db.rollback()
    assert db.execute(text("select status, quarantine_sha256, report from upload_file")).all() == before
    assert db.scalar(text("select count(*) from column_mapping")) == 0
    assert client.put(f"{API}/uploaded-files/{waiting}/mapping", json=STEPS).status_code == 200


def test_a_mapping_is_versioned_audited_and_can_be_removed(client: TestClient, send: Send, waiting: int, db: Session) -> None:
    made = client.put(f"{API}/uploaded-files/{waiting}/mapping", json=STEPS | {"reason": "as the manual says"}).json()["mapping"]
    removal = client.post(f"{API}/column-mappings/{made['id']}/removal", json={"reason": "the program changed"})
    assert (removal.status_code, removal.json()["removed"]) == (200, True)
    assert client.post(f"{API}/column-mappings/{made['id']}/removal", json={"reason": "again"}).status_code == 409
    number = wait(send, strange(beta=5.0))
    again = client.put(f"{API}/uploaded-files/{number}/mapping", json=STEPS | {"time_at": "begin"}).json()["mapping"]
    assert again["version"] == 3
    code = db.scalar(text("select code from study order by id"))
    listed = client.get(f"{API}/studies/{code}/column-mappings").json()
    assert [(m["version"], m["current"], m["removed"], m["time_at"]) for m in listed] == [
        (3, True, False, "begin"),
        (2, False, True, "end"),
        (1, False, False, "end"),
    ]
    said = db.execute(text("select action, reason from audit_event where entity = 'column_mapping' order by id")).all()
    assert [tuple(row) for row in said] == [("insert", "as the manual says"), ("insert", "the program changed"), ("insert", None)]
    with pytest.raises(Exception, match="column_mapping"):
        db.execute(text("update column_mapping set name = 'x'"))
    db.rollback()


def test_whoever_made_a_mapping_or_works_at_all_sites_may_remove_it() -> None:
    at_one_site = Caller("site@clinic.example", 2, (Grant(1, 5, Role.COORDINATOR),))
    at_all_sites = Caller("study@clinic.example", 3, (Grant(1, None, Role.COORDINATOR),))
    reads = Caller("reads@clinic.example", 4, (Grant(1, None, Role.VIEWER),))
    elsewhere = Caller("else@clinic.example", 5, (Grant(2, None, Role.COORDINATOR),))
    made_by = "site@clinic.example"
    assert [may_remove(c, 1, "other@clinic.example") for c in (at_one_site, at_all_sites, reads, elsewhere)] == [False, True, False, False]
    assert [may_remove(c, 1, made_by) for c in (at_one_site, at_all_sites, reads, elsewhere)] == [True, True, False, False]


def test_all_tables_of_an_upload_with_one_header_are_read_together(client: TestClient, send: Send) -> None:
    both = [(f"{i}.csv", strange(begin_ms=T0_MS + 600_000 * i, beta=1.0 + i)) for i in range(2)]
    answer = send(*both, visit=1)
    first, second = answer.json()["waits_for_mapping"]
    body = client.put(f"{API}/uploaded-files/{first}/mapping", json=STEPS).json()
    assert len(body["session_ids"]) == 2
    assert client.get(f"{API}/uploaded-files/{second}/preview").status_code == 404


def test_a_damaged_table_of_the_same_upload_waits_on_and_hides_no_result(client: TestClient, send: Send, db: Session) -> None:
    both = [(f"{i}.csv", strange(begin_ms=T0_MS + 600_000 * i, beta=1.0 + i)) for i in range(2)]
    first, second = send(*both, visit=1).json()["waits_for_mapping"]
    path_of(db.execute(text("select quarantine_sha256 from upload_file where id = :id"), {"id": second}).scalar_one()).write_bytes(b"x\n")
    answer = client.put(f"{API}/uploaded-files/{first}/mapping", json=STEPS)
    assert (answer.status_code, answer.json().get("waiting")) == (200, [second]), answer.text


def test_the_form_works_without_javascript(client: TestClient, client_as: Callable[[str], TestClient], waiting: int, db: Session) -> None:
    upload = db.scalar(text("select upload_id from upload_file"))
    assert f"/uploaded-files/{waiting}/mapping" in client.get(f"/uploads/{upload}", headers=PAGE).text
    page = unescape(client.get(f"/uploaded-files/{waiting}/mapping", headers=PAGE).text)
    assert "Zeit" in page
    assert "Export" not in page
    assert re.search(r'name="unit_2".*?<option value="uV" selected', page, re.S), "the unit's line is read"
    typed = {name: str(STEPS[name]) for name in ("name", "header_line", "unit_lines", "holds", "time_format", "time_at")}
    for column in STEPS["columns"]:
        typed |= {f"{part}_{column['number']}": column.get(part) or "" for part in ("role", "unit", "side", "channel")}
    wrong = client.post(f"/uploaded-files/{waiting}/mapping", headers=PAGE, data=typed | {"unit_2": "mA", "time_at": ""})
    assert wrong.status_code == 422
    said = unescape(wrong.text)
    assert {"Column 2", "A step's time"} <= set(re.findall(r'<a href="#f-[a-z_0-9]*">(.*?)</a>', said))
    assert 'value="0-2"' in said, "what was typed stays"
    right = client.post(f"/uploaded-files/{waiting}/mapping", headers=PAGE, data=typed, follow_redirects=False)
    assert (right.status_code, right.headers["location"]) == (303, f"/uploads/{upload}?done=mapped")
    code = db.scalar(text("select code from study order by id"))
    listed = unescape(client.get(f"/studies/{code}/column-mappings", headers=PAGE).text)
    assert "Clinic's system" in listed
    assert "a step's time is its end" in listed
    number = db.scalar(text("select id from column_mapping"))
    offered = f'action="/column-mappings/{number}/remove"'
    assert offered in listed
    assert offered not in client_as("viewer").get(f"/studies/{code}/column-mappings", headers=PAGE).text, "who may not is not asked"
    gone = client.post(f"/column-mappings/{number}/remove", headers=PAGE, data={"reason": "done"}, follow_redirects=False)
    assert gone.status_code == 303


def test_lfp_tremor_grasps_and_parquet_are_mapped_too(client: TestClient, send: Send, db: Session) -> None:
    lfp = "n,ECoG,STN\n" + "".join(f"{i},{(i % 25) - 12},{(i % 10) - 5}\n" for i in range(250 * 8))
    number = wait(send, lfp.encode())
    wanted: dict[str, Any] = {"name": "two channels", "header_line": 1, "holds": "lfp", "time_format": "samples", "rate_hz": 250}
    wanted["columns"] = columns((1, "time"), (2, "lfp", "uV", "left", "8-9"), (3, "lfp", "uV", "left", "1-3"))
    body = client.put(f"{API}/uploaded-files/{number}/mapping", json=wanted)
    assert body.status_code == 200, body.text
    kept = db.execute(text("select channel, unit, n, source from trace where stream = 'beta' order by channel")).all()
    assert [tuple(row) for row in kept] == [("1-3", "uV", 4, "time_domain"), ("8-9", "uV", 4, "time_domain")]

    watch = "Datum,kein,leicht,mild,mittel,stark,Name\n" + "".join(f"02.03.2026 11:{k:02}:00,50,25,25,0,0,Eva\n" for k in range(10))
    number = wait(send, watch.encode())
    wanted = {"name": "watch", "header_line": 1, "holds": "tremor", "time_format": "dmy", "zone": "Europe/Berlin"}
    roles = ("time", "tremor_none", "tremor_slight", "tremor_mild", "tremor_moderate", "tremor_strong")
    wanted["columns"] = columns(*enumerate(roles, 1))
    body = client.put(f"{API}/uploaded-files/{number}/mapping", json=wanted)
    assert body.status_code == 200, body.text
    assert "10 minutes of tremor" in body.json()["report"][0]["understood"]
    begins = np.frombuffer(db.scalar(text("select start_unix_s_f64 from tremor_series")), dtype="<f8")
    assert begins[0] == T0_MS / 1000, "11:00 in Berlin is 10:00 UTC in winter"

    grasps = "Oeffnung;Hand\n" + "".join(f"{500 * k};links\n" for k in range(1, 12))
    number = wait(send, grasps.replace("links", "left").encode())
    wanted = {"name": "grasp app", "header_line": 1, "holds": "grasp", "time_format": "milliseconds"}
    wanted["columns"] = columns((1, "time"), (2, "hand"))
    body = client.put(f"{API}/uploaded-files/{number}/mapping", json=wanted)
    assert body.status_code == 200, body.text
    assert "left hand: 11 open fists" in body.json()["report"][0]["understood"]

    sink = io.BytesIO()
    pq.write_table(pa.table({"when": [2.0 * k for k in range(1, 15)], "p": [k / 7 for k in range(14)], "i": [1.25] * 14}), sink)
    number = wait(send, sink.getvalue(), "t.parquet")
    wanted = {"name": "frames", "header_line": 1, "holds": "steps", "time_format": "seconds", "time_at": "end"}
    wanted["columns"] = columns((1, "time"), (2, "beta_power", "uV2"), (3, "amplitude_ma", "mA"))
    body = client.put(f"{API}/uploaded-files/{number}/mapping", json=wanted)
    assert body.status_code == 200, body.text
    assert any(line.startswith("beta: unit 'uV2' as the column mapping says") for line in body.json()["report"][0]["understood"])


def test_a_log_without_its_first_line_is_never_mapped(send: Send) -> None:
    rows = "".join(f"{2 * k},{2 * k},1,uV,1.5,1.5,follow\n" for k in range(12))
    answer = send(("log.csv", ("t_s,due_s,beta,unit,amplitude_ma,requested_ma,action\n" + rows).encode()), visit=1)
    assert answer.status_code == 422
    assert "log of a controller" in answer.json()["detail"]
    assert answer.json()["waits_for_mapping"] == [], "a mapping would put every amplitude to the wrong step"
