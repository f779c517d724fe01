"""A whole clinic day as three people and a tablet walk it: from the signed plan to the next generation, a bundle for each session.

Engineer, clinician and coordinator have the rights of their roles and no more. Each session is run by `betaloop control` from its own
bundle on a simulated device, whose beta answers the amplitude, on the simulation's clock. With `BETALOOP_SCREENSHOTS` set to a folder
(docs/visit, for those of docs/visit.md) pictures are taken on the way.
"""

from __future__ import annotations

import os
import subprocess
import sys
import time
import zipfile
from collections.abc import Callable
from dataclasses import asdict
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from app.accounts import service as accounts
from app.platform.database import transaction
from app.tables.accounts import Role
from ml.population import run_session
from ml.population.sessions import session_table_csv
from tests.app.conftest import ended, worker
from tests.browser.conftest import FLAGS, PASSWORD, Watched, kill_browser, program

__all__ = ["ended", "worker"]
pytestmark = [pytest.mark.browser, pytest.mark.slow]

MINUTES = 5
SHOTS = Path(os.environ["BETALOOP_SCREENSHOTS"]) if "BETALOOP_SCREENSHOTS" in os.environ else None
SMALL = {"preset": "quick", "updates": 60, "distil_updates": 60, "methods": ["posterior"], "seed": 3}
"""Of the first pipeline: enough to be trained, evaluated and ranked, not to be good."""
DROP = """(target, files) => {
  const carried = new DataTransfer();
  for (const { name, text } of files) carried.items.add(new File([text], name, { type: "text/csv" }));
  for (const kind of ["dragenter", "dragover", "drop"]) {
    target.dispatchEvent(new DragEvent(kind, { bubbles: true, cancelable: true, dataTransfer: carried }));
  }
}"""


def shot(watched: Watched, name: str) -> None:
    if SHOTS:
        SHOTS.mkdir(parents=True, exist_ok=True)
        watched.page.evaluate("() => scrollTo(0, 0)")
        watched.page.screenshot(path=SHOTS / f"{name}.jpg", type="jpeg", quality=30)


def sign_in_as(watched: Watched, who: str, path: str) -> None:
    watched.open(f"/sign-in?next={path}")
    watched.page.fill("[name=email]", f"{who}@clinic.example")
    watched.page.fill("[name=password]", PASSWORD)
    watched.page.click("main button")


def press(watched: Watched, button: str, done: str) -> None:
    """Press a button of a form, and wait for what the page says then; a refusal is reported in its own words."""
    watched.page.click(button)
    watched.page.locator(f".note.good:has-text('{done}'), .note.warn:has-text('{done}'), .note.bad[role=alert]").first.wait_for(
        timeout=90_000
    )
    assert watched.page.locator(f".note:has-text('{done}')").count(), watched.page.locator(".note.bad[role=alert]").all_inner_texts()


def tap(watched: Watched, act: str) -> None:
    watched.page.click(f"[data-act='{act}']")


def sent(watched: Watched) -> None:
    watched.page.wait_for_selector(".day-link[data-link=online][data-waiting='0']", timeout=30_000)


def kept(watched: Watched, n: int) -> None:
    watched.page.wait_for_selector(f".day-link[data-link=offline][data-waiting='{n}']", timeout=30_000)


def rate(watched: Watched, rating: int, grasp: str) -> None:
    """Enter all outcomes of a session, as the participant answers."""
    tap(watched, f"rating-{rating}")
    tap(watched, "type")
    watched.page.fill(".day-dialog input", grasp)
    tap(watched, "keep")
    watched.page.wait_for_selector("[data-value=grasp]:has-text('Hz')")
    for kind in ("dyskinesia", "speech", "gait"):
        tap(watched, f"{kind}-none")
    watched.page.wait_for_selector("[data-act='gait-none'][aria-pressed=true]")  # what is shown as entered is on the disk


@pytest.fixture
def people(client: TestClient) -> None:
    """People of that day, besides the administrator."""
    with transaction("test") as db:
        for role in (Role.ENGINEER, Role.CLINICIAN, Role.COORDINATOR):
            accounts.add_user(db, f"{role.value}@clinic.example", role, PASSWORD)


@pytest.fixture
def ranked(client: TestClient, participant_code: str, worker: None, ended: Callable[..., dict[str, Any]]) -> list[int]:
    """P1 after a visit of random and cDBS sessions, with two policies trained from it, and ranked; numbers of the trained ones."""
    settings = {"design": "stratified", "cdbs_amplitude_ma": 3.0, "xi_beta": 1.0, "beta_unit": "uV", "beta_source": "table"}
    assert client.put(f"/api/v1/participants/{participant_code}/settings", json={"settings": settings}).status_code == 200
    # two quickly trained policies are no good ones: with the widest margins the engineer may plan them without a clinician's word
    margins = {"grasp_share": 0.5, "rating_points": 5, "tremor_points": 50, "unsafe_beyond": 0.9, "nearly_off_share": 0.9}
    stated = client.put(f"/api/v1/participants/{participant_code}/margins", json={"margins": margins, "reason": "for this test"})
    assert stated.status_code == 200, stated.text
    for k, controller in enumerate(("random", "cdbs", "random", "random", "cdbs", "random")):
        held = run_session("P1", controller, seed=k, steps=30 * MINUTES, hour=0.4 * k)  # type: ignore[arg-type]
        of = {"participant": participant_code, "visit": "1", "controller": controller}
        sent = client.post("/api/v1/uploads", data=of, files={"file": (f"{k}.csv", session_table_csv(held))})
        assert sent.status_code == 201, sent.text
        qoc = asdict(held.qoc)
        client.put(f"/api/v1/sessions/{sent.json()['sessions'][0]['id']}/qoc", json=qoc)
    job = client.post(f"/api/v1/participants/{participant_code}/jobs", json={"kind": "pipeline", "count": 2, **SMALL})
    done = ended(job.json()["id"], 400)
    assert done["status"] == "succeeded", done
    found = client.get(f"/api/v1/participants/{participant_code}/ranking").json()["policies"]
    trained = [p for p in found if p["kind"] in ("trained", "distilled") and p["decision"] != "unsafe"]
    trained.sort(key=lambda p: p["decision"] == "test_with_care")  # of which a visit takes one
    assert len(trained) >= 2, [(p["name"], p["decision"], p["decision_reasons"]) for p in found]
    return [p["policy_id"] for p in trained[:2]]


def run_on_the_tablet(bundle: Path, key: str, log: Path, begins: datetime, ledger: Path) -> str:
    """Run `betaloop control` with the bundle of a session, and return its output: a simulated device answers every amplitude with beta."""
    options = ["--bundle", str(bundle), "--key", key, "--participant", "P1", "--ledger", str(ledger), "--source", "simulated:P1:4"]
    moment = begins.astimezone().strftime("%Y-%m-%dT%H:%M:%S")
    command = ["control", *options, "--begins", moment, "--time", "200", "--log", str(log)]
    ran = subprocess.run(
        [sys.executable, "-c", "from app.cli import main; main()", *command], check=False, timeout=120, capture_output=True, text=True
    )
    assert ran.returncode == 0, ran.stdout + ran.stderr
    return ran.stdout


@pytest.mark.synthetic
def test_a_clinic_day_from_the_signed_plan_to_the_next_generation(
    people: None,
    window: Callable[..., Watched],
    chromium: Any,
    address: str,
    client: TestClient,
    participant_code: str,
    ranked: list[int],
    ended: Callable[..., dict[str, Any]],
    tmp_path: Path,
) -> None:
    now = datetime.now(UTC)
    if (now + timedelta(hours=1)).date() != now.date():
        pytest.skip("the sessions of this day would run into the next one, on which no bundle of today runs")
    visit = client.post(f"/api/v1/participants/{participant_code}/visits", json={"number": 2, "date": now.date().isoformat()}).json()["id"]

    # the engineer drafts, and moves a session with the mouse
    engineer = window(1280, 900)
    sign_in_as(engineer, "engineer", f"/visits/{visit}/plan")
    for policy in ranked:
        fold = engineer.page.locator(f"details:not([open]):has([name=policy_ids][value='{policy}']) > summary")
        if fold.count():  # a student that does what its teacher does is in the teacher's fold
            fold.click()
        engineer.page.check(f"[name=policy_ids][value='{policy}']")
    for name, value in (("minutes_per_session", MINUTES), ("washout_minutes", 5), ("random_sessions", 1), ("seed", 5)):
        engineer.page.fill(f"[name={name}]", str(value))
    press(engineer, "form:has([name=policy_ids]) button.primary", "Plan drafted.")
    drafted = client.get(f"/api/v1/visits/{visit}/plan").json()["sessions"]
    rows = engineer.page.locator("[data-reorder] li")
    tested = [s["policy_id"] for s in drafted if s["controller"] not in ("cdbs", "no_dbs")]
    assert rows.count() == len(tested) == 3
    rows.nth(2).drag_to(rows.nth(0))
    engineer.page.wait_for_selector("text=Moved.")
    planned = client.get(f"/api/v1/visits/{visit}/plan").json()["sessions"]
    moved = [s["policy_id"] for s in planned if s["controller"] not in ("cdbs", "no_dbs")]
    assert moved == [tested[2], tested[0], tested[1]]

    # a clinician signs
    clinician = window(1280, 760)
    sign_in_as(clinician, "clinician", f"/visits/{visit}/plan")
    clinician.page.fill("[name=password]", PASSWORD)
    press(clinician, "form:has([name=password]) button.primary", "Plan signed.")
    shot(clinician, "1-signed-plan")

    # the engineer takes a bundle for each session
    engineer.open(f"/visits/{visit}/bundles")
    bundles = []
    for link in engineer.page.locator("a[href*='/plan/sessions/']").all():
        with engineer.page.expect_download() as coming:
            link.click()
        bundles.append(tmp_path / coming.value.suggested_filename)
        coming.value.save_as(bundles[-1])
    assert len({b.name for b in bundles}) == len(bundles) == len(planned)
    with zipfile.ZipFile(bundles[0]) as archive:
        assert "As on the sheet of plan" in archive.read("sheet.html").decode()
    key = engineer.page.locator("code").first.inner_text()

    # the coordinator runs the day: the network is cut in the second session, the tablet's browser dies in the third
    slots = client.get(f"/api/v1/visits/{visit}/day").json()["slots"]
    profile, logs = str(tmp_path / "profile"), []
    launch = chromium.browser_type.launch_persistent_context
    context = launch(profile, executable_path=program(), args=FLAGS, viewport={"width": 768, "height": 1024})
    tablet = Watched(context.new_page(), address)
    sign_in_as(tablet, "coordinator", f"/visit-day/{visit}")
    tablet.page.wait_for_selector("#day[data-ready=yes]")
    tablet.page.wait_for_function("() => caches.match('/visit-day/shell').then(Boolean)")
    tap(tablet, "dose")
    shot(tablet, "7-dose")
    tap(tablet, "dose-levodopa-100")
    tablet.page.wait_for_selector("[data-doses='1']")
    for number in range(1, len(slots) + 1):
        tap(tablet, "start")
        sent(tablet)
        if number == 1:
            shot(tablet, "2-running")
        logs.append(tmp_path / f"P1-visit-2-session-{number}.csv")
        told = run_on_the_tablet(bundles[number - 1], key, logs[-1], now + timedelta(minutes=10 * number), tmp_path / "ledger")
        assert "a decision takes 0." in told, told
        if number == 2:
            context.set_offline(True)
        rate(tablet, 5 + number, f"2.{number}")
        if number == 2:
            kept(tablet, 5)
            shot(tablet, "3-no-connection")
            tablet.page.reload()
            tablet.page.wait_for_selector("section[data-state=running]")
        if number == 3:
            kill_browser(profile)
            context = launch(profile, executable_path=program(), args=FLAGS, viewport={"width": 768, "height": 1024})
            context.clear_cookies()
            tablet = Watched(context.new_page(), address)
            sign_in_as(tablet, "coordinator", f"/visit-day/{visit}")
            tablet.page.wait_for_selector("section[data-session='3'][data-state=running]")
        tap(tablet, "stop")
        tap(tablet, "cause-other")
        context.set_offline(False)
        if number == 3:
            shot(tablet, "4-asked")
        tap(tablet, "finish")
    tap(tablet, "back")
    tablet.page.wait_for_selector("text=All entries are sent; none is left on this tablet.")
    context.close()
    entries = client.get(f"/api/v1/visits/{visit}/day/entries").json()["items"]
    assert [e["kind"] for e in entries].count("rating") == len(slots)
    assert {e["entered_by"] for e in entries} == {"coordinator@clinic.example"}
    assert len({e["uuid"] for e in entries}) == len(entries) == 9 * len(slots) + 2
    assert [(d["drug"], d["mg"]) for d in client.get(f"/api/v1/visits/{visit}/doses").json()] == [("levodopa", 100)]

    # the logs are dropped on the visit, and find their places by themselves
    coordinator = window(1280, 900)
    sign_in_as(coordinator, "coordinator", f"/visits/{visit}")
    coordinator.page.wait_for_selector("#slots")
    files = [{"name": log.name, "text": log.read_text()} for log in reversed(logs)]
    coordinator.page.locator("[data-drop]").evaluate(DROP, files)
    coordinator.page.wait_for_selector(f"#slots button:has-text('Confirm {len(slots)} sessions into their slots')", timeout=120_000)
    shot(coordinator, "5-logs-dropped")
    press(coordinator, "#slots button.primary", "Confirmed")
    shot(coordinator, "6-planned-and-done")
    filled = client.get(f"/api/v1/visits/{visit}/slots").json()
    assert (filled["found"], filled["missing"]) == (len(slots), [])
    for row, slot, session in zip(filled["rows"], slots, planned, strict=True):
        assert (row["position"], row["confirmed"]) == (slot["position"], True)
        # the simulated device's minutes pass in seconds, so that a log may be minutes from where the day's page says its session began
        assert set(row["deviations"]) <= {"other_time"}
        assert (row["done"]["rating"], row["done"]["grasp_hz"]) == (5 + slot["position"], 2 + slot["position"] / 10)
        assert 0 < row["done"]["energy"] <= 1.0 + 1e-6
        assert ("energy" in row["predicted"]) is (session["controller"] != "random"), "against what was predicted"
        assert client.get(f"/api/v1/sessions/{row['session_id']}").json()["hours_since_dose"] is not None

    # the tablets' times of decisions are on the visit; the engineer starts the next generation from there
    engineer.open(f"/visits/{visit}")
    assert "Controller on the tablet" in engineer.page.content()
    engineer.page.click("text=Train the next generation")
    engineer.page.select_option("[name=preset]", "quick")
    for name in ("parents", "tuned", "count"):
        engineer.page.fill(f"[name={name}]", "1")
    engineer.page.click("form button.primary")
    engineer.page.wait_for_url("**/jobs/*")
    shot(engineer, "8-next-generation")
    number = engineer.page.url.split("/jobs/")[1].split("?")[0]
    job = chosen(client, number)
    assert job["kind"] == "next_generation"
    steps = {s["key"]: s for s in job["steps"]}
    assert steps["choose-parents"]["status"] == "succeeded"
    assert "Fine-tune" in steps["train/0"]["title"], "it goes on from what was tested that day"

    # trained, distilled, evaluated and ranked by that one action; the next visit is planned from it
    done = ended(number, 900)
    assert done["status"] == "succeeded", done
    made = set(done["result"]["policy_ids"])
    engineer.page.goto(f"{address}/jobs/{number}")
    engineer.page.wait_for_selector("text=Succeeded")
    shot(engineer, "9-generation-done")
    kinds = [
        p["kind"] for p in client.get(f"/api/v1/participants/{participant_code}/policies?limit=200").json()["items"] if p["id"] in made
    ]
    assert {"trained", "distilled"} <= set(kinds), kinds
    found = client.get(f"/api/v1/participants/{participant_code}/ranking").json()
    assert made <= {p["policy_id"] for p in found["policies"]}, "every policy of the generation was judged"
    engineer.open(f"/participants/{participant_code}/next-generation")
    assert "The next generation is trained" in engineer.page.content()
    engineer.page.click("text=its ranking")
    engineer.page.wait_for_selector("h1")
    names = [p["name"] for p in found["policies"] if p["policy_id"] in made]
    assert all(name in engineer.page.content() for name in names), names
    assert engineer.errors + clinician.errors + coordinator.errors == []


def chosen(client: TestClient, number: str) -> dict[str, Any]:
    """Return a generation's job once it has chosen among the policies of that day those it goes on from, and trains."""
    deadline = time.monotonic() + 300
    while time.monotonic() < deadline:
        job: dict[str, Any] = client.get(f"/api/v1/jobs/{number}").json()
        assert job["status"] in ("queued", "running"), job
        if any(s["status"] == "running" and s["key"].startswith("train") for s in job["steps"]):
            return job
        time.sleep(0.5)
    raise AssertionError(f"no policy is trained after five minutes: {job}")
