"""Pages as a person meets them: real Chromium, real service."""

from __future__ import annotations

from collections.abc import Callable
from datetime import UTC, datetime, timedelta

import pytest
from fastapi.testclient import TestClient
from playwright.sync_api import expect
from sqlalchemy.orm import Session

from app.tables.jobs import Job, JobEvent, JobStatus, JobStep
from app.tables.participants import Participant

pytestmark = pytest.mark.browser

COLOURS = """() => [document.body, document.querySelector('#control path.js-line')].map((e) => e && getComputedStyle(e))
  .map((style) => style && `${style.color} ${style.stroke}`)"""
SMALL_TARGETS = """() => [...document.querySelectorAll('a, button, input:not([type=hidden]), select, summary, textarea')]
  .filter((e) => e.checkVisibility() && !e.closest('.modebar, .skip, .behind table'))
  .filter((e) => !e.closest('p, .note, .help, dd') || e.matches('button, .button'))
  .map((e) => [e, e.matches('input[type=checkbox], input[type=radio]') ? e.closest('label') : e])
  .map(([e, target]) => [e, target.getBoundingClientRect()])
  .filter(([e, box]) => box.width > 0 && (box.height < 43.5 || box.width < 43.5))
  .map(([e, box]) => `${e.tagName} "${e.textContent.trim().slice(0, 30)}" ${Math.round(box.width)}x${Math.round(box.height)}`)"""


def test_from_sign_in_to_a_participants_charts(window: Callable, study_world: list[int]) -> None:  # type: ignore[type-arg]
    watched = window()
    watched.sign_in()
    watched.page.click("article.participant h3 a")
    expect(watched.page.locator("h1")).to_have_text("P1")
    assert watched.charts_drawn() == 6
    assert watched.errors == []
    assert watched.foreign == []


def test_a_slash_leads_to_the_search_unless_somebody_types(window: Callable, study_world: list[int]) -> None:  # type: ignore[type-arg]
    watched = window()
    watched.signed_in()
    watched.open("/participants/P1/visits/new")
    watched.page.focus("[name=note]")
    watched.page.keyboard.press("/")
    assert (watched.page.input_value("[name=note]"), watched.page.input_value("#find")) == ("/", "")
    watched.page.evaluate("() => document.activeElement.blur()")
    watched.page.keyboard.press("/")
    watched.page.keyboard.type("p1")
    expect(watched.page.locator("#find")).to_have_value("p1")
    watched.page.keyboard.press("Enter")
    watched.page.wait_for_url("**/participants/P1")
    assert watched.errors == []


def test_the_time_left_of_a_job_moves_with_its_bar(window: Callable, participant_code: str, db: Session) -> None:  # type: ignore[type-arg]
    begun = datetime.now(UTC) - timedelta(seconds=590)
    owner = db.query(Participant).filter_by(code=participant_code).one().id
    step = JobStep(key="train/0", title="Train policy 1 (DDPG)", position=0, status=JobStatus.RUNNING, progress=0.5, started_at=begun)
    job = Job(
        id="4f00aaaa-0000-4000-8000-000000000000", participant_id=owner, kind="train", status=JobStatus.RUNNING, progress=0.5, params={},
        message="Train policy 1 (DDPG): update 2 of 4", code_version="1", created_by="test", started_at=begun, steps=[step],
    )  # fmt: skip
    db.add(job)
    db.commit()
    watched = window()
    watched.signed_in()
    watched.open(f"/jobs/{job.id}")
    left, bar = watched.page.locator("[data-time-left]"), watched.page.locator("[data-step=job]")
    expect(left).to_have_text("about 10 min left")
    expect(bar).to_contain_text("Train policy 1: update 2 of 4")
    told = {"progress": 0.8, "job_progress": 0.8, "seconds_left": 150.0, "message": "update 3 of 4"}
    db.add(JobEvent(job_id=job.id, step_key=step.key, kind="progress", data=told))
    db.commit()
    expect(bar).to_contain_text("80 %")
    expect(left).to_have_text("about 3 min left")
    assert watched.errors == []


def test_no_chart_offers_to_send_data_elsewhere(window: Callable, study_world: list[int]) -> None:  # type: ignore[type-arg]
    watched = window()
    watched.signed_in()
    watched.open(f"/sessions/{study_world[0]}")
    assert watched.charts_drawn() >= 1
    titles = [b.get_attribute("data-title") or "" for b in watched.page.query_selector_all(".modebar-btn")]
    assert titles, "the chart's own buttons are expected, e.g. download as a picture"
    assert [t for t in titles if any(word in t.lower() for word in ("share", "cloud", "edit", "plotly"))] == []
    assert watched.errors == []
    assert watched.foreign == []


BUTTONS_OVER = """() => [...document.querySelectorAll("figure[data-drawn=yes]")].flatMap((figure) => {
  const bar = figure.querySelector(".modebar").getBoundingClientRect();
  const over = (box) => bar.width > 0 && box.width > 0 && bar.bottom > box.top + 0.5 && bar.top < box.bottom - 0.5
    && bar.right > box.left && bar.left < box.right;
  const rects = (e) => { const range = document.createRange(); range.selectNodeContents(e); return [...range.getClientRects()]; };
  const words = [...figure.querySelectorAll("figcaption > *")].flatMap(rects);
  const data = over(figure.querySelector(".plot").getBoundingClientRect());
  return [...(data ? [`${figure.id}: data`] : []), ...(words.some(over) ? [`${figure.id}: title`] : [])];
})"""


def test_the_buttons_of_a_chart_cover_neither_its_data_nor_on_a_tablet_its_title(window: Callable, study_world: list[int]) -> None:  # type: ignore[type-arg]
    for width in (768, 1280):
        watched = window(width, 1024)
        watched.signed_in()
        for path in (f"/sessions/{study_world[0]}", "/participants/P1", "/participants/P1/analyses/paper"):
            watched.open(path)
            assert watched.charts_drawn() >= 1
            covered = watched.page.evaluate(BUTTONS_OVER)
            assert [c for c in covered if width == 768 or c.endswith("data")] == [], (width, path)


def test_the_session_chart_breaks_its_line_at_missing_beta(window: Callable, study_world: list[int]) -> None:  # type: ignore[type-arg]
    watched = window()
    watched.signed_in()
    watched.open(f"/sessions/{study_world[0]}")
    watched.charts_drawn()
    first = watched.page.query_selector("#control .scatterlayer .trace")
    assert len(first.query_selector_all("path.js-line")) == 2
    text = watched.page.text_content("#control .infolayer")
    assert "threshold 1 µV" in text
    assert "Amplitude (mA)" in text


def test_the_theme_is_chosen_kept_and_redraws_the_charts(window: Callable, study_world: list[int]) -> None:  # type: ignore[type-arg]
    watched = window(scheme="light")
    watched.signed_in()
    watched.open(f"/sessions/{study_world[0]}")
    watched.charts_drawn()
    light = watched.page.evaluate(COLOURS)
    watched.page.click("[data-theme-toggle]")
    watched.page.wait_for_function(f"(light) => ({COLOURS})().every((colour, i) => colour !== light[i])", arg=light)
    watched.page.reload()
    expect(watched.page.locator("html")).to_have_attribute("data-theme", "dark")


def test_paper_takes_every_chart_in_the_light_colours(window: Callable, study_world: list[int]) -> None:  # type: ignore[type-arg]
    """Also charts outside the scrolled part, and from a page in the dark theme."""
    watched = window(1280, 400, "dark")
    watched.signed_in()
    watched.open(f"/sessions/{study_world[0]}")
    charts = len(watched.page.query_selector_all("figure[data-chart]"))
    watched.page.wait_for_function("() => window.Plotly")
    watched.page.evaluate("() => dispatchEvent(new Event('beforeprint'))")
    watched.page.wait_for_function(f"() => document.querySelectorAll('figure[data-drawn=yes] .main-svg').length >= {charts}")
    ink = "() => getComputedStyle(document.querySelector('figure[data-drawn=yes] .xtick text, figure[data-drawn=yes] .xtitle')).fill"
    on_paper = watched.page.evaluate(ink)
    watched.page.evaluate("() => dispatchEvent(new Event('afterprint'))")
    watched.page.wait_for_function(f"(before) => ({ink})() !== before", arg=on_paper)
    assert watched.errors == []


def test_targets_are_large_enough_for_a_finger_on_a_tablet(window: Callable, study_world: list[int]) -> None:  # type: ignore[type-arg]
    watched = window(820, 1180)
    watched.signed_in()
    paths = ["/", "/participants/P1", "/participants/P1/visits", "/visits/1", f"/sessions/{study_world[0]}", "/participants/P1/settings"]
    for path in [*paths, "/participants/P1/upload", "/participants/new", "/account", "/accounts"]:
        watched.open(path)
        for scheme in ("light", "dark"):
            watched.page.emulate_media(color_scheme=scheme)
            assert watched.page.evaluate(SMALL_TARGETS) == [], (path, scheme)
            wide = watched.page.evaluate("() => document.documentElement.scrollWidth - document.documentElement.clientWidth")
            assert wide <= 0, f"{path} is {wide} px wider than the tablet in the {scheme} theme"
    assert watched.errors == []


def test_files_dropped_on_the_upload_page_become_sessions(
    window: Callable, participant_code: str, client: TestClient, table: bytes
) -> None:  # type: ignore[type-arg]
    watched = window()
    watched.signed_in()
    watched.open(f"/participants/{participant_code}/upload?visit=1")
    watched.page.select_option("[name=controller]", "cdbs")
    files = [["good.csv", table.decode()], ["bad <b>.csv", "a,b\n1,2\n"], ["again.csv", table.decode()]]
    transfer = watched.page.evaluate_handle(
        "(files) => { const t = new DataTransfer(); files.forEach(([name, text]) => t.items.add(new File([text], name))); return t; }",
        files,
    )
    watched.page.dispatch_event("[data-drop]", "drop", {"dataTransfer": transfer})
    outcomes = ["received", "read", "2 to look at", "columns not known", "1 problem", "known already"]
    told = watched.page.locator("[data-upload-list] .badge:not(dt .badge)")
    expect(told).to_have_text(outcomes, timeout=60_000)
    folds = watched.page.locator("[data-upload-list] details.file")
    assert [fold.get_attribute("open") is not None for fold in folds.all()] == [False, True, False], "open where there is a problem"
    expect(folds.first.locator("summary")).to_contain_text("good.csv")
    expect(folds.first.locator("summary .line")).to_contain_text("rows of 2 s")
    assert not watched.page.is_visible("[data-upload-list] dt:has-text('Understood')")
    expect(watched.page.locator("[data-upload-list] li").first).to_contain_text("bad <b>.csv")
    assert client.get("/api/v1/visits/1/sessions").json()["total"] == 1
    assert watched.page.locator("[data-upload-list] a", has_text="Say what its columns are").count() == 1
    watched.page.click("[data-upload-list] li a")
    assert watched.charts_drawn() == 2


def test_a_refused_upload_says_so_at_the_field_and_keeps_the_files(
    window: Callable, participant_code: str, client: TestClient, table: bytes
) -> None:  # type: ignore[type-arg]
    watched = window()
    watched.signed_in()
    watched.open(f"/participants/{participant_code}/upload?visit=1")
    page = watched.page
    page.select_option("[name=controller]", "rl")
    page.fill("[name=policy]", "nobody")
    page.evaluate("() => { document.querySelector('form details').open = true; }")
    page.fill("[name=beta_unit]", "au")
    page.evaluate("() => document.querySelector('[name=beta_source]').add(new Option('x', 'hearsay', true, true))")
    page.set_input_files("input[type=file]", {"name": "t.csv", "mimeType": "text/csv", "buffer": table})
    chosen = "() => [...document.querySelector('input[type=file]').files].map((f) => `${f.name} ${f.size}`)"
    page.click("button.primary")
    expect(page.locator("#n-beta_source")).to_contain_text("Input should be", timeout=60_000)
    expect(page.locator("#f-beta_source")).to_have_attribute("aria-describedby", "h-beta_source n-beta_source")
    assert page.evaluate(chosen) == [f"t.csv {len(table)}"]
    page.select_option("[name=beta_source]", "")
    page.click("button.primary")
    expect(page.locator("#n-policy")).to_contain_text("has no policy 'nobody'", timeout=60_000)
    expect(page.locator(".field-note")).to_have_count(1)
    expect(page.locator("[aria-invalid]")).to_have_attribute("name", "policy")
    page.click("[data-upload-list] li:first-child a[href='#f-policy']")
    assert page.evaluate(chosen) == [f"t.csv {len(table)}"]
    page.fill("[name=policy]", "")
    page.select_option("[name=controller]", "cdbs")
    page.click("button.primary")
    expect(page.locator("[data-upload-list] li").first).to_contain_text("received", timeout=60_000)
    expect(page.locator(".field-note, [aria-invalid]")).to_have_count(0)
    assert page.evaluate(chosen) == []
    assert client.get("/api/v1/visits/1/sessions").json()["total"] == 1


def test_a_table_alone_whose_columns_nobody_knows_leads_to_its_mapping(window: Callable, participant_code: str) -> None:  # type: ignore[type-arg]
    watched = window(768, 1024)
    watched.signed_in()
    watched.open(f"/participants/{participant_code}/upload?visit=1")
    rows = "".join(f"{2 * k};{1 + k % 5};2.0\n" for k in range(1, 12)).encode()
    watched.page.set_input_files("input[type=file]", {"name": "t.csv", "mimeType": "text/csv", "buffer": b"Zeit;Signal;Strom\n" + rows})
    watched.page.click("button.primary")
    watched.page.click("[data-upload-list] a:has-text('Say what its columns are')", timeout=60_000)
    expect(watched.page.locator("h1")).to_have_text("What the columns are")


def test_tables_of_unknown_columns_alone_lead_to_their_mappings_and_each_says_what_is_wrong(
    window: Callable, participant_code: str
) -> None:  # type: ignore[type-arg]
    watched = window()
    watched.signed_in()
    watched.open(f"/participants/{participant_code}/upload?visit=1")
    transfer = watched.page.evaluate_handle(
        "() => { const t = new DataTransfer(); for (const [n, x] of [['one.csv', 'a,b\\n1,2\\n3,4\\n'], ['two.csv', 'c,d\\n1,2\\n3,4\\n']])"
        " t.items.add(new File([x], n)); return t; }"
    )
    watched.page.dispatch_event("[data-drop]", "drop", {"dataTransfer": transfer})
    item = watched.page.locator("[data-upload-list] li")
    expect(item.locator(".badge").first).to_have_text("columns not known", timeout=60_000)
    expect(item.locator("summary b")).to_have_text(["one.csv", "two.csv"])
    expect(item.locator(".note.bad")).to_have_count(2)
    expect(item.locator("summary", has_text="files in it")).to_have_count(0)
    expect(item.locator("a.button")).to_have_text(["Say what its columns are (1 of 2)", "Say what its columns are (2 of 2)"])
    item.locator("a.button").last.click()
    expect(watched.page.locator("select[name=role_1]")).to_be_visible()


def test_what_cannot_be_taken_back_asks_first(window: Callable, participant_code: str) -> None:  # type: ignore[type-arg]
    watched = window()
    watched.signed_in()
    watched.open("/account")
    watched.page.fill("[name=name]", "a tablet")
    watched.page.click("text=Make token")
    assert watched.page.inner_text("code.secret").startswith("blp_")
    row = watched.page.locator("tr", has_text="a tablet")
    row.locator("button").click()
    watched.page.click("dialog[open] >> text=Keep the token")
    expect(row.locator(".badge")).to_have_text("live")
    row.locator("button").click()
    assert watched.page.inner_text("dialog[open] [value=yes]") == "Revoke the token"
    watched.page.click("dialog[open] [value=yes]")
    watched.page.wait_for_selector("text=Token revoked")
    expect(row.locator(".badge")).to_have_text("revoked")


def test_tables_sort_numbers_as_numbers_with_missing_ones_last(window: Callable, study_world: list[int], client: TestClient) -> None:  # type: ignore[type-arg]
    client.put(f"/api/v1/sessions/{study_world[1]}/qoc", json={"grasp_hz": None, "reason": "taken back"})
    watched = window()
    watched.signed_in()
    watched.open("/visits/1")
    grasp = watched.page.locator("table.data tbody td:nth-child(8)")
    expect(grasp).to_have_text(["2.00", "—", "4.00"])
    watched.page.click("table.data th:nth-child(8) button")
    expect(grasp).to_have_text(["2.00", "4.00", "—"])
    watched.page.click("table.data th:nth-child(8) button")
    expect(grasp).to_have_text(["4.00", "2.00", "—"])
    expect(watched.page.locator("table.data th:nth-child(8)")).to_have_attribute("aria-sort", "descending")
