"""The forms of the loop from learning to the clinic day say at each field what is wrong with it, as in test_errors_at_fields."""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import Any

from fastapi.testclient import TestClient
from sqlalchemy import select, update
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.learning.policies import constant_onnx
from app.learning.snapshots import take_snapshot
from app.study.repository import participant_by_code
from app.tables.learning import Policy
from app.tables.uploads import ColumnMapping
from tests.app.evaluations import policies as policies
from tests.app.pages.entries.test_errors_at_fields import WHY, Sent, refused
from tests.app.pages.entries.test_errors_of_files_and_visits import UNKNOWN
from tests.clinic_day import ClinicDay
from tests.clinic_day import clinic_day as clinic_day

HOME = "/participants/P1"
SignIn = Callable[[str], TestClient]


def test_forms_of_policies_say_errors_at_their_fields(policies: list[int], sign_in: SignIn) -> None:
    browser = sign_in("admin")  # the policies come first: their fixture is a copy made once
    add, one = f"{HOME}/policies", f"{HOME}/policies/{policies[0]}"
    file: dict[str, Any] = {"files": {"file": ("x.onnx", constant_onnx(0.5, 10))}}
    gate = f"{HOME}/buffer-gate"
    forms = [
        Sent(add, {"name": "p0"} | file, "f-name", "already has a policy 'p0'", 'value="p0"'),
        Sent(add, {"name": ""} | file, "f-name", "give a value", 'id="f-file"'),
        Sent(add, {"name": "new"}, "f-file", "No file was chosen", 'value="new"'),
        Sent(add, {"name": "new", "files": {"file": ("x.onnx", b"no network")}}, "f-file", "is no policy", 'value="new"'),
        Sent(f"{one}/retire", {"reason": " "}, "f-reason", "retired with a reason", 'id="f-reason"'),
        Sent(f"{one}/retire", {"reason": WHY}, "f-reason", "at most 1000", WHY),
        Sent(gate, {"choice": "", "reason": "agreed"}, "f-choice", "give a value", ">agreed</textarea>"),
        Sent(gate, {"choice": "shut", "reason": " "}, "f-reason", "", 'value="shut" selected'),
    ]
    assert refused(browser, forms) == {}
    retired = browser.post(f"{one}/retire", data={"reason": "worn out"}, follow_redirects=False)
    assert retired.headers["location"] == f"{one}?done=retired"
    assert "worn out" in browser.get(one).text
    back = browser.post(f"{one}/retire", data={"back": "yes"}, follow_redirects=False)
    assert back.headers["location"] == f"{one}?done=back"
    assert "worn out" not in browser.get(one).text


def test_the_form_of_the_next_generation_says_errors_at_its_fields(
    client: TestClient, db: Session, policies: list[int], upload: Callable[..., int], sign_in: SignIn
) -> None:
    browser = sign_in("admin")
    snapshot = take_snapshot(db, participant_by_code(db, "P1", SYSTEM), SYSTEM)
    db.execute(update(Policy).where(Policy.id.in_(policies)).values(kind="trained", algorithm="ddpg", snapshot_id=snapshot.id))
    db.commit()
    client.post("/api/v1/participants/P1/visits", json={"number": 2})
    upload("rl", visit=2, policy=str(policies[0]))
    page, asked = f"{HOME}/next-generation", {"preset": "quick", "parents": "2", "tuned": "2", "count": "6"}
    forms = [
        Sent(page, asked | {"parents": "9"}, "f-parents", "less than or equal to 6", 'value="9"'),
        Sent(page, asked | {"tuned": "a few"}, "f-tuned", "'a few' is no whole number", 'value="a few"'),
        Sent(page, asked | {"count": "0"}, "f-count", "greater than or equal to 1", 'value="quick" selected'),
        Sent(page, asked | {"preset": "huge"}, "f-preset", "Input should be", 'id="f-preset"'),
    ]
    assert refused(browser, forms) == {}


def test_forms_of_sessions_participants_and_mappings_say_errors_at_their_fields(
    browser: TestClient, client: TestClient, db: Session, session_id: int
) -> None:
    readable = b"t_s,beta,amplitude_fraction\n" + b"".join(b"%d,1,0.7\n" % (2 * k) for k in range(-9, 30))
    both = [("file", ("t.csv", UNKNOWN)), ("file", ("s.csv", readable))]
    sent = client.post("/api/v1/uploads", data={"participant": "P1"}, files=both).json()["files"][0]["id"]
    columns = [
        {"number": 1, "role": "time"},
        {"number": 2, "role": "beta", "unit": "a.u."},
        {"number": 3, "role": "amplitude_ma", "unit": "mA"},
    ]
    wanted = {"name": "tables", "holds": "steps", "header_line": 1, "time_format": "seconds", "time_at": "end", "columns": columns}
    read = client.put(f"/api/v1/uploaded-files/{sent}/mapping", json=wanted)
    assert read.status_code == 200, read.text
    mapping = db.scalar(select(ColumnMapping.id))
    remove = f"f-remove-{mapping}-reason"
    status = f"{HOME}/status"
    forms = [
        Sent(f"/sessions/{session_id}/exclusion", {"excluded_reason": " "}, "f-excluded_reason", "needs a reason", "<details open>"),
        Sent(status, {"status": "withdrawn", "status_reason": " "}, "f-status_reason", "There is no reason", 'value="withdrawn" selected'),
        Sent(status, {"status": "gone", "status_reason": "moved"}, "f-status", "Choose whether", ">moved</textarea>"),
        Sent(f"/column-mappings/{mapping}/remove", {"reason": " "}, remove, "needs a reason", f'id="{remove}"'),
    ]
    assert refused(browser, forms) == {}
    assert client.get("/api/v1/participants/P1").json()["status"] == "active"


def test_the_choice_of_a_visit_says_errors_at_its_fields(client: TestClient, policies: list[int], sign_in: SignIn) -> None:
    browser = sign_in("admin")
    draft, ticked = f"{HOME}/plan/draft", {"policy_ids": str(policies[0])}
    new = ticked | {"visit_number": "7", "visit_date": "2199-01-01"}
    kept = f'name="policy_ids" value="{policies[0]}"'
    forms = [
        Sent(draft, new | {"visit_number": "1"}, "f-visit_number", "already has a visit 1", kept),
        Sent(draft, new | {"visit_number": "many"}, "f-visit_number", "'many' is no whole number", 'value="2199-01-01"'),
        Sent(draft, new | {"visit_date": ""}, "f-visit_date", "has no date", 'value="7"'),
        Sent(draft, new | {"visit_date": "soon"}, "f-visit_date", "valid date", kept),
    ]
    assert refused(browser, forms) == {}
    visit = client.post("/api/v1/participants/P1/visits", json={"number": 2}).json()["id"]
    wrong = ticked | {"visit_id": str(visit), "washout_minutes": "999"}
    assert refused(browser, [Sent(draft, wrong, "f-washout_minutes", "less than or equal to 120", 'value="999"')]) == {}


def test_the_plain_forms_of_the_clinic_day_say_errors_at_their_fields(browser: TestClient, clinic_day: ClinicDay) -> None:
    assert clinic_day.outcomes(clinic_day.entry("start"), clinic_day.entry("stop")) == ["stored"] * 2
    medication = {"medication": [{"drug": "levodopa", "mg": 100, "at": "08:00"}]}
    body = {"version": 0, "characteristics": medication, "reason": "asked"}
    assert clinic_day.client.put("/api/v1/participants/P1/characteristics", json=body).status_code == 200
    day, slot = f"/visit-day/{clinic_day.visit}", {"plan_item_id": str(clinic_day.slots[0]), "attempt": "1"}

    def entry(kind: str, **typed: str) -> dict[str, str]:
        return {"kind": kind, "plan_id": str(clinic_day.plan), "uuid": "00000000-0000-4000-8000-000000000001"} | slot | typed

    dose = {"kind": "dose", "plan_id": str(clinic_day.plan), "uuid": "00000000-0000-4000-8000-000000000002", "drug": "levodopa"}
    event = {"kind_of_event": "fall", "severity": "severe", "note": "slipped"}
    forms = [
        Sent(day, entry("grasp", hz="fast"), "f-hz", "'fast' is no number", 'value="fast"'),
        Sent(day, entry("grasp", hz="45"), "f-hz", "less than 20", 'value="45"'),
        Sent(day, entry("note", text="Seen by Miller on 3 May"), "f-text", "3 May", ">Seen by Miller on 3 May</textarea>"),
        Sent(day, entry("repeat", reason=" "), "f-reason", "give a value", 'id="f-reason"'),
        Sent(day, entry("repeat", reason="called 0171 5555"), "f-reason", "0171 5555", 'value="called 0171 5555"'),
        Sent(day, entry("adverse_event", **event | {"note": "Smith slipped"}), "f-note", "Smith", 'value="severe" selected'),
        Sent(day, entry("adverse_event", **event | {"kind_of_event": "x"}), "f-kind_of_event", "Input should be", 'value="slipped"'),
        Sent(day, dose | {"mg": "much"}, "f-mg", "'much' is no number", 'value="much"'),
        Sent(day, dose | {"mg": "100", "taken_at": "2000-01-01T09:00"}, "f-taken_at", "is not near visit", 'value="2000-01-01T09:00"'),
    ]
    assert refused(browser, forms) == {}
    page = browser.post(day, data=forms[2].typed).text
    assert page.count('class="field-note"') == 1, "at that form alone"
    assert re.search(r'name="no_names_ok" value="[^"]*Miller', page)
