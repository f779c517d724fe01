"""Pages of the study: every page answers, every form works without JavaScript, nothing that people type becomes markup."""

from __future__ import annotations

import json
import re
from collections.abc import Callable
from html import unescape

import pytest
from fastapi.testclient import TestClient

PARTICIPANT_PAGES = ("", "/visits", "/visits/new", "/settings", "/upload", "/analyses", "/ranking", "/plans", "/jobs")


@pytest.mark.parametrize("tail", PARTICIPANT_PAGES)
def test_every_page_of_a_participant_answers_before_and_after_the_first_session(
    tail: str, browser: TestClient, client: TestClient, session_id: int
) -> None:
    client.post("/api/v1/participants", json={"code": "E9"})
    for code in ("P1", "E9"):
        answer = browser.get(f"/participants/{code}{tail}")
        assert answer.status_code == 200, answer.text
        assert answer.headers["content-type"].startswith("text/html")


@pytest.mark.parametrize("path", ["/", "/account", "/accounts", "/audit", "/participants/new"])
def test_every_page_of_the_study_answers(path: str, browser: TestClient, participant_code: str) -> None:
    assert browser.get(path).status_code == 200


def test_what_does_not_exist_is_a_page_and_not_json(browser: TestClient) -> None:
    for path in ("/participants/NOBODY", "/visits/999", "/sessions/999", "/uploads/999", "/nowhere"):
        answer = browser.get(path)
        assert answer.status_code == 404
        assert "<h1>" in answer.text


def test_the_overview_names_what_needs_attention(browser: TestClient, client: TestClient, session_id: int) -> None:
    client.post("/api/v1/participants", json={"code": "E9"})
    page = browser.get("/").text
    assert "Beta threshold is not set; jobs cannot start" in page
    assert "1 session without outcomes" in page
    assert "n = 2" in page


def test_a_participant_is_enrolled_by_form_with_its_settings(browser: TestClient, client: TestClient) -> None:
    fields = dict(re.findall(r'<input id="f-(\w+)" name="\w+" type="\w+" value="([^"]*)"', browser.get("/participants/new").text))
    assert fields["window"] == "10"
    done = browser.post("/participants", data=fields | {"code": "P7", "xi_beta": "1,5", "tremor_as_fraction": "no", "beta_source": ""})
    assert done.headers["location"] == "/participants/P7?done=enrolled"
    settings = client.get("/api/v1/participants/P7").json()["settings"]
    assert (settings["xi_beta"], settings["window"], settings["tremor_as_fraction"], settings["beta_source"]) == (1.5, 10, False, None)
    assert "Participant enrolled" in browser.get(done.headers["location"]).text


def test_a_refused_form_comes_back_as_it_was_typed_and_names_the_field(browser: TestClient, client: TestClient) -> None:
    refused = browser.post("/participants", data={"code": "P 7<", "gamma": "1.5", "window": "ten"})
    assert refused.status_code == 422
    assert "Code (letters, digits, - and _)" in refused.text
    refused = browser.post("/participants", data={"code": "P7", "gamma": "1.5", "window": "ten"})
    assert "&#39;ten&#39; is no whole number" in refused.text
    assert 'value="1.5"' in refused.text
    assert client.get("/api/v1/participants/P7").status_code == 404


def test_settings_change_by_form_makes_a_version_with_its_reason(browser: TestClient, client: TestClient, participant_code: str) -> None:
    url = f"/participants/{participant_code}/settings"
    assert browser.post(url, data={"gamma": "0.9", "reason": "shorter <sight>"}).headers["location"].endswith("done=changed")
    page = unescape(browser.get(url).text)
    assert "Discount γ: 0.99 → <b>0.9</b>" in page
    assert "shorter <sight>" not in browser.get(url).text
    assert browser.post(url, data={"gamma": "0.9"}).headers["location"].endswith("done=same")
    assert client.get(f"/api/v1/participants/{participant_code}").json()["settings"]["version"] == 2
    assert browser.post(url, data={"beta_low_hz": "40"}).status_code == 422


def test_a_missing_threshold_is_suggested_and_taken_with_one_button(browser: TestClient, client: TestClient, session_id: int) -> None:
    client.post("/api/v1/participants", json={"code": "P2", "settings": {"cdbs_amplitude_ma": 2.0, "beta_unit": "uV"}})
    client.post("/api/v1/participants/P2/visits", json={"number": 1})
    assert "A suggestion needs one session with valid beta" in browser.get("/participants/P2/settings").text
    rows = "\n".join(["t_s,beta,amplitude_fraction", *(f"{2 * i},{2.5},1" for i in range(-9, 30))])
    data = {"participant": "P2", "visit": "1", "controller": "cdbs"}
    assert client.post("/api/v1/uploads", data=data, files={"file": ("a.csv", rows.encode())}).status_code == 201
    button = re.search(r'name="xi_beta" value="([\d.]+)"', browser.get("/participants/P2/settings").text)
    assert button is not None
    assert button[1] == "2.5"
    browser.post("/participants/P2/settings", data={"xi_beta": button[1]})
    assert client.get("/api/v1/participants/P2").json()["settings"]["xi_beta"] == 2.5


def test_a_visit_is_added_by_form_with_the_amplitude_of_each_side(browser: TestClient, client: TestClient, participant_code: str) -> None:
    assert 'value="2"' in browser.get(f"/participants/{participant_code}/visits/new").text
    fields = {"number": "2", "date": "2026-04-01", "note": "<script>alert(1)</script>", "cdbs_left": "2.5", "cdbs_right": ""}
    done = browser.post(f"/participants/{participant_code}/visits", data=fields)
    assert done.status_code == 303
    page = browser.get(done.headers["location"]).text
    assert "left 2.5 mA" in page
    assert "<script>alert(1)" not in page
    assert "&lt;script&gt;alert(1)&lt;/script&gt;" in page
    again = browser.post(f"/participants/{participant_code}/visits", data=fields)
    assert again.status_code == 409
    assert "already has a visit 2" in again.text
    assert browser.post(f"/participants/{participant_code}/visits", data={"number": "0"}).status_code == 422


def figures(page: str) -> list[dict[str, dict[str, object]]]:
    return [json.loads(unescape(text)) for text in re.findall(r'<script type="application/json">(.*?)</script>', page, re.S)]


def test_the_session_chart_keeps_gaps_and_flags_what_exceeds_cdbs(browser: TestClient, session_id: int) -> None:
    page = browser.get(f"/sessions/{session_id}").text
    traces = {t["name"]: t for t in figures(page)[0]["data"] if "name" in t}  # type: ignore[union-attr,index]
    beta, amplitude, above = (traces[n] for n in ("Beta amplitude", "Amplitude", "above cDBS"))  # type: ignore[index]
    assert [i - 9 for i, v in enumerate(beta["y"]) if v is None] == [11, 12, 13]  # type: ignore[index]
    assert (amplitude["y"][0], max(amplitude["y"])) == (1.5, pytest.approx(3.6, abs=1e-6))  # type: ignore[index]
    assert len(above["x"]) == 1  # type: ignore[index]
    assert "1 of 40 steps above 100 % of the cDBS amplitude" in page
    assert "n = 37 of 40 steps with a valid window" in page
    assert "1, longest 6 s" in page


def test_the_stimulation_table_has_one_row_per_amplitude(browser: TestClient, session_id: int) -> None:
    page = browser.get(f"/sessions/{session_id}").text
    table = page[page.index("Stimulation steps") :]
    table = table[table.index("<tbody>") : table.index("</tbody>")]
    steps = [re.findall(r'class="num">([^<]*)<', row) for row in re.findall(r"<tr>(.*?)</tr>", table, re.S)]
    assert [(s[0], s[1], s[3], s[4]) for s in steps] == [("0", "38", "1.50", "50"), ("38", "40", "3.60", "120"), ("40", "80", "1.50", "50")]


def test_qocs_are_entered_and_corrected_by_form(browser: TestClient, client: TestClient, session_id: int) -> None:
    url = f"/sessions/{session_id}/qoc"
    assert browser.post(url, data={"grasp_hz": "2.5", "rating": "7", "tremor_percent": ""}).status_code == 303
    refused = browser.post(url, data={"grasp_hz": "2.5", "rating": "11", "tremor_percent": "x"})
    assert refused.status_code == 422
    assert "Tremor" in refused.text
    assert 'value="11"' in refused.text
    assert browser.post(url, data={"grasp_hz": "2.4", "rating": "7", "tremor_percent": "10", "reason": "read wrongly"}).status_code == 303
    qoc = client.get(f"/api/v1/sessions/{session_id}/qoc").json()
    assert (qoc["grasp_hz"], qoc["rating"], qoc["tremor_percent"], qoc["revision"]) == (2.4, 7, 10.0, 2)
    assert "read wrongly" in browser.get(f"/sessions/{session_id}").text


def test_saving_the_form_again_keeps_digits_that_it_does_not_show(browser: TestClient, client: TestClient, session_id: int) -> None:
    client.put(f"/api/v1/sessions/{session_id}/qoc", json={"grasp_hz": 2.4790827393, "rating": 7, "tremor_percent": 0.0})
    fields = dict(
        re.findall(r'name="(grasp_hz|rating|tremor_percent)" type="text" value="([^"]*)"', browser.get(f"/sessions/{session_id}").text)
    )
    assert fields == {"grasp_hz": "2.479", "rating": "7", "tremor_percent": "0"}
    assert browser.post(f"/sessions/{session_id}/qoc", data=fields | {"rating": "8", "tremor_percent": ""}).status_code == 303
    qoc = client.get(f"/api/v1/sessions/{session_id}/qoc").json()
    assert (qoc["grasp_hz"], qoc["rating"], qoc["tremor_percent"]) == (2.4790827393, 8, None)


def test_a_session_is_excluded_with_a_reason_and_included_again(browser: TestClient, client: TestClient, session_id: int) -> None:
    url = f"/sessions/{session_id}/exclusion"
    assert browser.post(url, data={"excluded_reason": "  "}).status_code == 422
    assert browser.post(url, data={"excluded_reason": "cable <loose>"}).status_code == 303
    assert client.get(f"/api/v1/sessions/{session_id}").json()["excluded_reason"] == "cable <loose>"
    page = browser.get(f"/sessions/{session_id}").text
    assert "cable &lt;loose&gt;" in page
    assert browser.post(url, data={"include": "yes"}).status_code == 303
    assert client.get(f"/api/v1/sessions/{session_id}").json()["excluded_reason"] is None


def test_a_wrong_controller_is_corrected_by_form(browser: TestClient, client: TestClient, session_id: int) -> None:
    url = f"/sessions/{session_id}/correction"
    fields = {"controller": "random", "policy": "", "hemisphere": "left", "control": "beta\t", "reason": "typed wrongly"}
    assert browser.post(url, data=fields).status_code == 303
    session = client.get(f"/api/v1/sessions/{session_id}").json()
    assert (session["controller"], session["hemisphere"]) == ("random", "left")
    refused = browser.post(url, data=fields | {"policy": "no such policy"})
    assert refused.status_code == 422
    assert "no such policy" in refused.text


def test_the_audit_trail_shows_who_changed_what_and_can_be_filtered(browser: TestClient, session_id: int) -> None:
    browser.post(f"/sessions/{session_id}/exclusion", data={"excluded_reason": "cable <loose>"})
    page = browser.get(f"/audit?entity=session&entity_id={session_id}").text
    assert "admin-page@clinic.example" in page
    assert "cable &lt;loose&gt;" in page
    assert "2 rows in all" in page
    assert "Nothing matches" in browser.get("/audit?actor=nobody").text
    assert "Next" in browser.get("/audit?limit=5").text


def test_a_viewer_reads_everything_and_finds_no_form_to_write_with(
    sign_in: Callable[[str], TestClient], client: TestClient, session_id: int
) -> None:
    viewer = sign_in("viewer")
    for path in ("/", "/participants/P1", "/participants/P1/visits", "/participants/P1/settings", f"/sessions/{session_id}"):
        page = viewer.get(path)
        assert page.status_code == 200
        assert re.findall(r'<form method="post" action="(?!/sign-out)[^"]+" class="(?!fields wide)', page.text) == []
    for path in ("/participants/new", "/participants/P1/visits/new", "/participants/P1/upload", "/audit"):
        assert viewer.get(path).status_code == 403
    for path, fields in (
        ("/participants", {"code": "P8"}),
        ("/participants/P1/settings", {"gamma": "0.5"}),
        ("/participants/P1/visits", {"number": "9"}),
        (f"/sessions/{session_id}/qoc", {"rating": "5"}),
        (f"/sessions/{session_id}/exclusion", {"excluded_reason": "no"}),
        (f"/sessions/{session_id}/correction", {"controller": "rl"}),
    ):
        assert viewer.post(path, data=fields).status_code == 403, path
    assert client.get("/api/v1/participants/P1").json()["settings"]["version"] == 1


def test_the_upload_form_takes_files_and_reports_on_each(
    browser: TestClient, client: TestClient, participant_code: str, table: bytes
) -> None:
    url, fields = (
        f"/participants/{participant_code}/upload",
        {"visit": "1", "controller": "cdbs", "policy": "", "started_at": "", "hemisphere": ""},
    )
    files = [("file", ("good.csv", table)), ("file", ("<b>bad.csv", b"a,b\n1,2\n"))]
    page = browser.post(url, data=fields, files=files)
    assert page.status_code == 200
    assert "good.csv" in page.text
    assert "&lt;b&gt;bad.csv" in page.text
    assert "columns not known" in page.text
    again = browser.post(url, data=fields, files=[("file", ("good.csv", table))])
    assert "known already" in again.text
    assert client.get("/api/v1/visits/1/sessions").json()["total"] == 1
    assert browser.post(url, data=fields, files=[("file", ("bad.csv", b"nothing"))]).status_code == 422
    refused = browser.post(url, data=fields | {"controller": "warp"}, files=[("file", ("good.csv", table))])
    assert refused.status_code == 422
    assert "Controller" in refused.text
    report = re.search(r"/uploads/\d+", again.text)
    assert report is not None
    assert browser.get(report[0]).status_code == 200


def test_no_page_has_inline_scripts_or_foreign_addresses(browser: TestClient, session_id: int) -> None:
    for path in ("/", "/participants/P1", f"/sessions/{session_id}", "/participants/P1/upload", "/participants/P1/settings", "/account"):
        page = browser.get(path)
        assert re.findall(r"<script(?![^>]*(?:src=|application/json))", page.text) == []
        assert re.findall(r'\son\w+="', page.text) == []
        assert re.findall(r'(?:src|href|action)="(?:https?:)?//', page.text) == []
        assert "script-src 'self'" in page.headers["content-security-policy"]


def test_static_files_are_found_under_their_hash(browser: TestClient) -> None:
    page = browser.get("/").text
    urls = set(re.findall(r'(?:src|href)="(/static/[^"]+)"', page))
    assert len(urls) >= 6
    for url in urls:
        answer = browser.get(url)
        assert answer.status_code == 200
        assert "immutable" in answer.headers["cache-control"]
    library = re.search(r'name="betaloop-plotly" content="([^"]+)"', page)
    assert library is not None
    assert browser.get(library[1]).status_code == 200
