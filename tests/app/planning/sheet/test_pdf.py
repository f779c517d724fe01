"""The printed sheet of a visit plan."""

from __future__ import annotations

import io
import re
from html import unescape
from itertools import pairwise
from typing import Any

import pytest
from fastapi.testclient import TestClient
from hypothesis import given
from hypothesis import strategies as st
from pypdf import PdfReader

from app.planning.sheet.ink import latin
from tests.app.words import methods_named


def _sheet(client: TestClient, visit_id: int) -> list[str]:
    answer = client.get(f"/api/v1/visits/{visit_id}/plan.pdf")
    assert answer.status_code == 200
    assert answer.headers["content-type"] == "application/pdf"
    pages = PdfReader(io.BytesIO(answer.content)).pages
    assert all(round(float(p.mediabox.width)) == 842 and round(float(p.mediabox.height)) == 595 for p in pages)  # A4 landscape, points
    return [re.sub(r"\s+", " ", p.extract_text()) for p in pages]


def test_a_draft_says_so_and_holds_everything_that_the_clinic_needs(client: TestClient, study_world: Any) -> None:
    body = {"policy_ids": list(study_world.policies), "seed": 7, "no_dbs": True, "note": "left hand only"}
    plan = client.post(f"/api/v1/visits/{study_world.visit}/plan", json=body).json()
    pages = _sheet(client, study_world.visit)
    text = " ".join(pages)
    for words in (
        "DRAFT",
        "NOT APPROVED",
        "Visit plan P1 visit 2",
        "Note: left hand only",
        "rl-01-small",
        "energy 40 % of cDBS",
        "Limits",
        "Bundle not taken yet",
        "Started",
        "Rating",
        "Grasp",
        "Tremor",
        "Stop rules",
        "return to the clinical stimulation",
        "name, signature, date",
        f"Page 1 of {len(pages)}",
        f"plan {plan['id']}, seed 7, evaluation {study_world.evaluation}, snapshot {plan['evaluation']['snapshot_id']}",
        "by admin@clinic.example",
        "Verdict cannot tell: without the chances of every outcome: evaluate again",
        "100 % under cDBS",
        "! The recordings say too little of what policy 'rl-02-small' does",
    ):
        assert words in text, words
    rows = [f"{s['position']} {int(s['start_minute']) // 60}:{int(s['start_minute']) % 60:02d} " for s in plan["sessions"]]
    places = [text.index(row, text.index("Stimulation site")) for row in rows]
    assert places == sorted(places)
    assert methods_named(text) == []
    assert "93 to 96.5" not in text, "what a session is worth by the study's scores is for engineers"


def test_an_approved_sheet_has_no_watermark_and_names_who_approved(client: TestClient, study_world: Any, sign_plan: Any) -> None:
    client.post(f"/api/v1/visits/{study_world.visit}/plan", json={"policy_ids": [study_world.policies[0]]})
    assert sign_plan(study_world.visit).status_code == 200
    (text,) = _sheet(client, study_world.visit)
    assert "DRAFT" not in text
    assert "NOT APPROVED" not in text
    assert "Approved by signer@clinic.example" in text


def test_a_long_day_goes_over_pages_with_its_head_repeated(client: TestClient, study_world: Any) -> None:
    client.put("/api/v1/participants/P1/settings", json={"settings": {"design": "paper"}})
    body = {"policy_ids": list(study_world.policies), "random_sessions": 10, "total_minutes": 600, "note": "word " * 300}
    client.post(f"/api/v1/visits/{study_world.visit}/plan", json=body)
    pages = _sheet(client, study_world.visit)
    assert len(pages) >= 2
    for number, text in enumerate(pages, start=1):
        assert f"Page {number} of {len(pages)}" in text
        assert "Visit plan P1 visit 2" in text
        assert "DRAFT" in text
    assert sum(text.count("Started hh:mm") for text in pages) == client.get(f"/api/v1/visits/{study_world.visit}/plan").text.count(
        '"position"'
    )


def test_the_sheet_says_who_the_participant_is_and_when_medication_is_due(client: TestClient, study_world: Any) -> None:
    stated = {
        "leads": [{"hemisphere": "left", "target": "stn", "sensing": "0-2", "stimulating": "C+1-"}],
        "hand": "right",
        "medication": [{"drug": "levodopa", "mg": 100, "at": "07:00"}, {"drug": "levodopa", "mg": 50, "at": "09:20"}],
    }
    change = {"version": 0, "characteristics": stated, "reason": "asked"}
    assert client.put("/api/v1/participants/P1/characteristics", json=change).status_code == 200
    body = {"policy_ids": [study_world.policies[0]], "starts_at": "09:00"}
    plan = client.post(f"/api/v1/visits/{study_world.visit}/plan", json=body).json()
    due = [s["medication"] for s in plan["sessions"]]
    assert due[0].startswith("07:00 Levodopa")
    begins = [s["start_minute"] for s in plan["sessions"]]
    assert [bool(d) for d in due] == [True, *(a < 20 <= b for a, b in pairwise(begins))]
    page = unescape(client.get(f"/visits/{study_world.visit}/plan", headers={"Accept": "text/html"}).text)
    assert page.count("due before:") == sum(bool(d) for d in due), "who signs reads it, whatever runs"
    assert "other_medication" not in [w["code"] for w in plan["warnings"]]
    text = " ".join(_sheet(client, study_world.visit))
    for words in (
        "Leads: left STN, sensing 0-2, stimulating C+1-",
        "Hand of the grasp test: right",
        "1 09:00 cDBS",
        f"due before: {due[0]}",
    ):
        assert words in text, words
    later = {"version": 1, "characteristics": stated | {"medication": []}, "reason": "changed by the neurologist"}
    assert client.put("/api/v1/participants/P1/characteristics", json=later).status_code == 200
    now = client.get(f"/api/v1/visits/{study_world.visit}/plan").json()
    assert [s["medication"] for s in now["sessions"]] == due
    assert [w["code"] for w in now["warnings"] if w["code"] == "other_medication"] == ["other_medication"]
    assert "schedule was changed after this plan was drafted" in " ".join(_sheet(client, study_world.visit))


def test_a_blinded_sheet_has_letters_and_common_limits_and_predicts_nothing(client: TestClient, study_world: Any, sign_plan: Any) -> None:
    client.put("/api/v1/participants/P1/settings", json={"settings": {"cdbs_amplitude_ma": 3.0}})
    body = {"policy_ids": [study_world.policies[0]], "blinded": True}
    client.post(f"/api/v1/visits/{study_world.visit}/plan", json=body)
    assert sign_plan(study_world.visit).status_code == 200
    text = " ".join(_sheet(client, study_world.visit))
    assert "Session A" in text
    assert text.count("Limits") == text.count("Started hh:mm")
    assert "Stop rules" in text
    for words in ("Predicted", "Policy", "Bundle 1", "not taken yet", "rl-01-small", "energy 40 %"):
        assert words not in text, words


def test_the_sheet_has_the_amplitudes_of_random_sessions_and_their_bound(client: TestClient, study_world: Any) -> None:
    client.put("/api/v1/participants/P1/settings", json={"settings": {"cdbs_amplitude_ma": 3.0}})
    plan = client.post(
        f"/api/v1/visits/{study_world.visit}/plan", json={"policy_ids": [study_world.policies[0]], "random_sessions": 1}
    ).json()
    design = next(s["design"] for s in plan["sessions"] if s["design"])
    text = " ".join(" ".join(_sheet(client, study_world.visit)).split())
    assert f"stratified design: level {design['level']:.2f} of cDBS" in text
    assert "never below 0.9 mA (0.3 of cDBS)" in text
    second = design["holds"][1]
    ma = max(round(second["amplitude"] * 3.0, 1), 0.9)
    assert f"{2 * second['start'] // 60}:{2 * second['start'] % 60:02d} {ma:.1f}" in text


def test_names_outside_latin_1_are_spelled(client: TestClient, study_world: Any, external: int) -> None:
    client.post(f"/api/v1/visits/{study_world.visit}/plan", json={"policy_ids": [external], "note": "雨 – β ≥ 2 µV"})
    (text,) = _sheet(client, study_world.visit)
    assert re.search(rf'beta-Regler "Lódz" ?\(#{external}\)', text)
    assert f"Policy 'beta-Regler \"Lódz\" (#{external})' is not in the ranking." in text
    assert "Note: ? - beta >= 2 µV" in text


@pytest.mark.parametrize(
    ("text", "printed"),
    [
        ("β γ Ω", "beta gamma Omega"),
        ("Łódź", "Lódz"),
        ("a–b — “c”…", 'a-b - "c"...'),
        ("çåß µ ±", "çåß µ ±"),
        ("ﬁ", "fi"),
        ("雨\x00\u200b", "?"),
        ("ή", "eta"),
    ],
)
def test_every_character_has_a_spelling_or_a_question_mark(text: str, printed: str) -> None:
    assert latin(text) == printed


@given(st.text())
def test_whatever_is_typed_fits_the_built_in_fonts(text: str) -> None:
    printed = latin(text)
    assert printed.encode("latin-1").decode("latin-1") == printed
