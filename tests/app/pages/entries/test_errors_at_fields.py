"""A refused form says at each field what is wrong with it, leads there from the box on top, and keeps what was typed."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import dataclass
from html import unescape
from typing import Any

import pytest
from fastapi.testclient import TestClient

from app.study.adverse_event_types import EVENT_KINDS
from ml.rl import MlpPolicy
from tests.app.evaluations import judge as judge
from tests.app.evaluations import judged
from tests.app.evaluations import policies as policies
from tests.app.ingest.conftest import steady
from tests.app.pages.test_stale_forms import fields_of

WHY = "0123456789" * 101
"""A reason that is longer than any field takes."""


@dataclass(frozen=True)
class Sent:
    """A form with one bad value, and the place of its error.

    Attributes:
        address: where it is sent. typed: its fields. field: id of the one that is wrong. says: the text at it. kept: what the page keeps,
            as its HTML writes it.
    """

    address: str
    typed: dict[str, Any]
    field: str
    says: str
    kept: str


@pytest.fixture
def study(browser: TestClient, client: TestClient, session_id: int, table: bytes) -> dict[str, int]:
    """Numbers of a session, an event, a policy, a visit to plan and a proposal of P1."""
    event = client.post("/api/v1/participants/P1/adverse-events", json={"kind": "speech", "severity": "severe", "serious": True})
    network = MlpPolicy(10, (20, 10), mean=1.0, std=0.5, seed=1).to_onnx()
    policy = client.post("/api/v1/participants/P1/policies", data={"name": "lyon"}, files={"file": ("x.onnx", network)})
    visit = client.post("/api/v1/participants/P1/visits", json={"number": 2, "date": "2046-04-06"})
    proposed = client.post("/api/v1/uploads", data={"participant": "P1", "visit": "1"}, files={"file": ("p.csv", steady(0.5))})
    assert [a.status_code for a in (event, policy, visit, proposed)] == [201] * 4, (event.text, policy.text, visit.text, proposed.text)
    return {
        "session": session_id,
        "event": event.json()["id"],
        "policy": policy.json()["id"],
        "visit": visit.json()["id"],
        "proposal": proposed.json()["proposals"][0]["session"]["id"],
    }


def held_against(page: str, sent: Sent) -> list[str]:
    """List what is missing of an error at its field."""
    tag = next((t for t in re.findall(r"<[a-z]+ [^>]*>", page) if f' id="{sent.field}"' in t), "")
    name = sent.field.removeprefix("f-")
    note = re.search(rf'<div class="field-note" id="n-{re.escape(name)}">(.*?)</div>', page, re.S)
    box = page[page.index('<div class="note bad" role="alert">') :]
    box = box[: re.search(r"</div>\s*\n(?=<[a-z])", box).end()] if re.search(r"</div>\s*\n(?=<[a-z])", box) else box
    missing = []
    if not tag:
        missing.append("no such field")
    elif not tag.startswith(("<fieldset", "<tr", "<div")):
        described = re.findall(r' aria-describedby="([^"]*)"', tag)
        if 'aria-invalid="true"' not in tag or len(described) != 1 or f"n-{name}" not in described[0].split():
            missing.append(f"not marked: {tag}")
    if note is None or sent.says not in unescape(note[1]):
        missing.append(f"says {note[1] if note else 'nothing'}")
    if f'<a href="#{sent.field}">' not in page:
        missing.append("the box does not lead to it")
    if sent.kept not in page:
        missing.append("what was typed is gone")
    return missing


def refused(browser: TestClient, forms: list[Sent]) -> dict[str, list[str]]:
    """List, by form, what is missing in the page that refuses it."""
    found = {}
    for sent in forms:
        typed = {name: value for name, value in sent.typed.items() if name != "files"}
        answer = browser.post(sent.address, data=typed, files=sent.typed.get("files"))
        assert answer.status_code in (404, 409, 422), (sent.address, answer.status_code)
        if missing := held_against(answer.text, sent):
            found[f"{sent.address} {sent.field}"] = missing
    return found


def test_forms_of_the_study_say_errors_at_their_fields(browser: TestClient, study: dict[str, int]) -> None:
    event, home = study["event"], "/participants/P1"
    margins = fields_of(browser.get(f"{home}/margins").text, f"{home}/margins")
    lead = {"lead1_hemisphere": "left", "lead1_target": "stn", "lead1_stimulating": "everywhere", "version": "0", "reason": "asked"}
    other = next(kind.value for kind, name in EVENT_KINDS.items() if name.startswith("Other"))
    new, correct, clear = f"{home}/adverse-events", f"/adverse-events/{event}/correction", f"/adverse-events/{event}/clearance"
    speech = {"kind": "speech", "severity": "mild"}
    forms = [
        Sent(f"{home}/margins", margins | {"grasp_share": "much", "reason": "why"}, "f-grasp_share", "'much' is no number", 'value="much"'),
        Sent(f"{home}/margins", margins | {"grasp_share": "0.2", "reason": ""}, "f-reason", "Say why in a sentence", 'value="0.2"'),
        Sent(f"{home}/margins/lock", {"version": "1", "lock_reason": WHY}, "f-lock_reason", "at most 1000", WHY),
        Sent(f"{home}/characteristics", lead, "f-lead1_stimulating", "not written as this field takes it", 'value="everywhere"'),
        Sent(f"{home}/characteristics", lead | {"dose3_drug": "levodopa", "dose3_mg": "many", "lead1_stimulating": "2"}, "f-dose3_mg",
             "'many' is no number", 'value="many"'),
        Sent(f"{home}/characteristics", lead | {"lead1_stimulating": "2", "reason": ""}, "f-reason", "A reason is missing", 'value="2"'),
        Sent(new, speech | {"session_id": "99999", "note": "slow"}, "f-event-session_id", "There is no session 99999", ">slow</textarea>"),
        Sent(new, speech | {"session_id": "one"}, "f-event-session_id", "'one' is no whole number", 'value="one"'),
        Sent(new, {"kind": other, "severity": "mild"}, "f-event-note", "say what happened in the note", f'value="{other}" selected'),
        Sent(correct, speech | {"revision": "1", "reason": "", "note": "mumbled"}, f"f-correct-{event}-reason", "", ">mumbled</textarea>"),
        Sent(clear, {"revision": "1", "reason": WHY}, f"f-clear-{event}-reason", "at most 1000", WHY),
    ]  # fmt: skip
    assert refused(browser, forms) == {}


def test_a_form_that_was_sent_for_one_event_shows_its_error_at_that_one_alone(browser: TestClient, study: dict[str, int]) -> None:
    event = study["event"]
    page = browser.post(f"/adverse-events/{event}/clearance", data={"revision": "1", "reason": WHY}).text
    assert page.count('class="field-note"') == 1
    assert re.search(r"<details open><summary>Clear it", page)
    assert "<details open><summary>Correct it" not in page
    assert f'id="f-correct-{event}-reason" name="reason" type="text" value=""' in page


def test_forms_of_files_and_proposals_say_errors_at_their_fields(browser: TestClient, study: dict[str, int], table: bytes) -> None:
    home, number = "/participants/P1", study["proposal"]
    files: dict[str, Any] = {"files": [("file", ("again.csv", table))]}
    upload = {"visit": "1", "controller": "cdbs"}
    shown = fields_of(browser.get(f"{home}/proposals").text, f"{home}/proposals")

    def proposal(do: str, **typed: str) -> dict[str, str]:
        return shown | {f"{name.replace('_', '-')}": text for name, text in typed.items()} | {"do": f"{do}:{number}"}

    forms = [
        Sent(f"{home}/upload", upload | {"visit": "77"} | files, "f-visit", "has no visit 77", "has no visit 77"),
        Sent(f"{home}/upload", upload | {"policy": "nobody"} | files, "f-policy", "no policy 'nobody'", 'value="nobody"'),
        Sent(f"{home}/upload", upload | {"beta_unit": "u" * 50} | files, "f-beta_unit", "at most 40", "u" * 50),
        Sent(f"{home}/upload", upload | {"beta_source": "hearsay"} | files, "f-beta_source", "Input should be", 'value="cdbs" selected'),
        Sent(f"{home}/proposals", proposal("confirm", **{f"to_{number}": "soon"}), f"to-{number}", "'soon' is no time", 'value="soon"'),
        Sent(f"{home}/proposals", proposal("confirm", **{f"to_{number}": "900:00"}), f"to-{number}", "not within it", 'value="900:00"'),
        Sent(f"{home}/proposals", proposal("confirm", **{f"policy_{number}": "nobody", f"controller_{number}": "rl"}), f"policy-{number}",
             "no policy 'nobody'", 'value="nobody"'),
        Sent(f"{home}/proposals", proposal("confirm"), f"controller-{number}", "cannot be confirmed yet", f'id="controller-{number}"'),
        Sent(f"{home}/proposals", proposal("discard"), f"reason-{number}", "Say why this is no session", f'id="reason-{number}"'),
        Sent(f"{home}/proposals", proposal("split", **{f"part_{number}_0_from": "x", f"part_{number}_0_to": "0:20"}), f"part-1-{number}",
             "'x' is no time", 'value="x"'),
        Sent(f"{home}/proposals", proposal("split"), f"parts-{number}", "No part is filled in", f'id="parts-{number}"'),
    ]  # fmt: skip
    assert refused(browser, forms) == {}
    # as a browser sends an empty field of files
    parts = "".join(f'--x\r\nContent-Disposition: form-data; name="{n}"\r\n\r\n{v}\r\n' for n, v in upload.items())
    parts += (
        '--x\r\nContent-Disposition: form-data; name="file"; filename=""\r\nContent-Type: application/octet-stream\r\n\r\n\r\n--x--\r\n'
    )
    page = browser.post(f"{home}/upload", content=parts.encode(), headers={"Content-Type": "multipart/form-data; boundary=x"}).text
    assert held_against(page, Sent("", {}, "f-file", "No file was chosen", 'value="cdbs" selected')) == []


def test_forms_of_jobs_plans_and_bundles_say_errors_at_their_fields(browser: TestClient, study: dict[str, int]) -> None:
    home, visit, policy = "/participants/P1", study["visit"], study["policy"]
    jobs, draft = f"{home}/jobs", f"/visits/{visit}/plan"
    bundle = f"{home}/policies/{policy}/bundle"
    day = fields_of(browser.get(draft).text, draft) | {"random_sessions": "2"}
    held = {"held_unit": "amplitude_ma", "held_amplitude": "99", "held_sessions": "2"}
    limits = {"min_ma": "0", "max_ma": "3", "ramp_ma_per_s": "1.5"}
    forms = [
        Sent(jobs, {"kind": "pipeline", "count": "99"}, "f-count", "less than or equal to 24", 'value="99"'),
        Sent(jobs, {"kind": "pipeline", "seed": "a few"}, "f-seed", "'a few' is no whole number", 'value="a few"'),
        Sent(jobs, {"kind": "pipeline", "methods": ["tarot"], "sweep": "mine"}, "f-methods", "'tarot' is no method", 'value="mine"'),
        Sent(jobs, {"kind": "nothing"}, "f-kind", "names no kind of job", 'id="f-kind"'),
        Sent(draft, day | {"washout_minutes": "999"}, "f-washout_minutes", "less than or equal to 120", 'value="999"'),
        Sent(draft, day | {"max_ma": "1", "note": "quiet room"}, "f-max_ma", "leave out the cDBS amplitude", ">quiet room</textarea>"),
        Sent(draft, day | {"policy_ids": "x"}, "f-policy_ids", "'x' is no policy", 'value="2"'),
        Sent(draft, day | held, "f-held_amplitude-0", "less than or equal to", 'value="99"'),
        Sent(bundle, limits | {"min_ma": "low"}, "f-min_ma", "'low' is no number", 'value="low"'),
        Sent(bundle, limits | {"max_ma": "1"}, "f-max_ma", "cannot be made", 'value="1.5"'),
        Sent(f"{home}/policies/{policy}/release", limits | {"ramp_ma_per_s": "0"}, "f-release-ramp_ma_per_s", "greater than", 'value="0"'),
    ]  # fmt: skip
    assert refused(browser, forms) == {}
    page = browser.post(f"{home}/policies/{policy}/release", data=limits | {"min_ma": "low"}).text
    assert page.count('class="field-note"') == 1, "the form that was not sent has no error"
    assert page.count('value="low"') == 1, "and none of what was typed into the other"
    few = browser.post(jobs, data={"kind": "pipeline", "count": "99"}).text
    assert "default factory" not in few
    assert few.count('class="field-note"') == 1


@pytest.mark.hazard("H04")
def test_a_plan_that_a_verdict_refuses_says_so_at_the_policy(
    policies: list[int], judge: Callable[..., int], sign_in: Callable[[str], TestClient]
) -> None:
    browser, (unsafe, careful, other) = sign_in("admin"), policies  # the policies come first: their fixture is a copy made once
    care: dict[str, Any] = {"supported": False, "support": {"lowest_supported": 0.5, "dose": 0.4}}
    off = judged(50.0, behaviour={"below_cdbs_20_percent": 0.42})
    judge({unsafe: off, careful: judged(60.0, **care), other: judged(60.0, **care)})
    visit = browser.post("/api/v1/participants/P1/visits", json={"number": 2}).json()["id"]
    draft = f"/visits/{visit}/plan"
    day = fields_of(browser.get(draft).text, draft) | {"random_sessions": "2", f"override_{unsafe}": "", "note": "quiet"}
    needs, reason = "not to be run without a clinician", ">quiet</textarea>"
    forms = [
        Sent(draft, day | {"policy_ids": [str(unsafe)]}, f"f-override_{unsafe}", needs, reason),
        Sent(draft, day | {"policy_ids": [str(careful)], f"limit_{careful}": "0.2"}, f"f-limit_{careful}", "not to 0.20", 'value="0.2"'),
        Sent(draft, day | {"policy_ids": [str(careful), str(other)]}, "f-policy_ids", "a visit takes one of them", reason),
    ]
    assert refused(browser, forms) == {}
    assert "overrides" not in browser.post(draft, data=forms[0].typed).text, "a clinician is not told what the API calls a field"
    assert refused(sign_in("engineer"), forms[:1]) == {}, "who cannot give the reason is told where it is missing"


def test_the_box_leads_to_the_fields_of_the_older_forms_too(
    browser: TestClient, sign_in: Callable[[str], TestClient], session_id: int
) -> None:
    settings = "/participants/P1/settings"
    fields = fields_of(browser.get(settings).text, settings)
    forms = [
        Sent(settings, fields | {"gamma": "7", "reason": "why"}, "f-gamma", "must lie between 0 and 0.9999", 'value="7"'),
        Sent("/participants/P1/visits", {"number": "0", "note": "kept"}, "f-number", "greater than or equal to 1", ">kept</textarea>"),
    ]
    assert refused(browser, forms) == {}
