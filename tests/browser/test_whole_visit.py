"""A whole visit as the clinic walks it: engineer, clinician, coordinator and the tablet, from the signed plan to the next generation.

With `BETALOOP_SCREENSHOTS` set to a folder (docs/visit, for those of docs/visit.md) pictures are taken on the way.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest
from fastapi.testclient import TestClient

from app.accounts import service as accounts
from app.accounts.models import Role
from app.learning.policies.baselines import constant_onnx, proportional_onnx
from app.platform.database import transaction
from ml.policies.policy import ProportionalPolicy
from tests.browser.conftest import FLAGS, PASSWORD, Watched, kill_browser, program

pytestmark = [pytest.mark.browser, pytest.mark.slow]

STEPS = 150
SHOTS = Path(os.environ["BETALOOP_SCREENSHOTS"]) if "BETALOOP_SCREENSHOTS" in os.environ else None


def shot(watched: Watched, name: str) -> None:
    if SHOTS:
        SHOTS.mkdir(parents=True, exist_ok=True)
        watched.page.evaluate("() => scrollTo(0, 0)")
        watched.page.screenshot(path=SHOTS / f"{name}.jpg", type="jpeg", quality=30)


def sign_in_as(watched: Watched, who: str, path: str) -> None:
    watched.open(f"/sign-in?next={path}")
    fill(watched, who)


def fill(watched: Watched, who: str) -> None:
    watched.page.fill("[name=email]", f"{who}@clinic.example")
    watched.page.fill("[name=password]", PASSWORD)
    watched.page.click("main button")


def tap(watched: Watched, act: str) -> None:
    watched.page.click(f"[data-act='{act}']")


def sent(watched: Watched) -> None:
    watched.page.wait_for_selector(".day-link[data-link=online][data-waiting='0']", timeout=30_000)


def kept(watched: Watched, n: int) -> None:
    watched.page.wait_for_selector(f".day-link[data-link=offline][data-waiting='{n}']", timeout=30_000)


def rate(watched: Watched, rating: int, grasp: str) -> None:
    """All that is asked about a session, as the participant answers it."""
    tap(watched, f"rating-{rating}")
    tap(watched, "type")
    watched.page.fill(".day-dialog input", grasp)
    tap(watched, "keep")
    watched.page.wait_for_selector("[data-value=grasp]:has-text('Hz')")
    for kind in ("dyskinesia", "speech", "gait"):
        tap(watched, f"{kind}-none")


@pytest.fixture
def people(client: TestClient) -> None:
    """Who is there that day, beside the administrator."""
    with transaction("test") as db:
        for who, role in (("engineer", Role.ENGINEER), ("clinician", Role.CLINICIAN), ("coordinator", Role.CLINICIAN)):
            accounts.add_user(db, f"{who}@clinic.example", role, PASSWORD)


@pytest.fixture
def policies(client: TestClient, enrolled: str) -> dict[str, int]:
    """Two policies that no training made: one holds an amplitude, one follows beta."""
    files = {"steady": constant_onnx(0.8, 10), "following": proportional_onnx(ProportionalPolicy(0.5, 2.0, 0.4), 10)}
    path = f"/api/v1/participants/{enrolled}/policies"
    added = {n: client.post(path, data={"name": n}, files={"file": (f"{n}.onnx", content)}) for n, content in files.items()}
    return {name: answer.json()["id"] for name, answer in added.items()}


def run_on_the_tablet(client: TestClient, policy: int, seed: int, log: Path) -> None:
    """`betaloop control` with the bundle of a policy: a synthetic participant answers every amplitude with beta."""
    bundle, key = log.with_suffix(".zip"), client.get("/api/v1/bundle-key").text.strip()
    bundle.write_bytes(client.get(f"/api/v1/policies/{policy}/bundle").content)
    options = ["--bundle", str(bundle), "--key", key, "--participant", "P1", "--source", f"cohort:P1:{seed}"]
    command = ["control", *options, "--speed", "fast", "--steps", str(STEPS), "--log", str(log)]
    subprocess.run([sys.executable, "-c", "from app.cli import main; main()", *command], check=True, timeout=120, capture_output=True)


def conventional(log: Path) -> None:
    """What a recording of conventional stimulation looks like as a table."""
    rows = [f"{2 * k},{1.2 + 0.2 * (k % 5)},1" for k in range(-9, STEPS + 1)]
    log.write_text("\n".join(["t_s,beta,amplitude_fraction", *rows]))


def test_a_visit_from_the_signed_plan_to_the_next_generation(
    people: None,
    window: Callable[..., Watched],
    chromium: Any,
    address: str,
    client: TestClient,
    enrolled: str,
    policies: dict[str, int],
    tmp_path: Path,
) -> None:
    day = datetime.now(UTC).date().isoformat()
    visit = client.post(f"/api/v1/participants/{enrolled}/visits", json={"number": 2, "date": day}).json()["id"]

    # the engineer drafts, a clinician signs
    engineer = window(1280, 900)
    sign_in_as(engineer, "engineer", f"/visits/{visit}/plan")
    for policy in policies.values():
        engineer.page.check(f"[name=policy_ids][value='{policy}']")
    engineer.page.fill("[name=minutes_per_session]", "5")
    engineer.page.fill("[name=washout_minutes]", "0")
    engineer.page.click("form:has([name=policy_ids]) button.primary")
    engineer.page.wait_for_selector("text=Plan drafted.")
    clinician = window(1280, 760)
    sign_in_as(clinician, "clinician", f"/visits/{visit}/plan")
    clinician.page.fill("[name=password]", PASSWORD)
    clinician.page.click("form:has([name=password]) button.primary")
    clinician.page.wait_for_selector("text=Plan signed.")
    shot(clinician, "1-signed-plan")
    slots = client.get(f"/api/v1/visits/{visit}/day").json()["slots"]
    assert sorted(s["controller"] for s in slots) == ["cdbs", "rl", "rl"]

    # the coordinator runs the day: the network is cut in the second session, the tablet dies in the third
    profile, logs = str(tmp_path / "profile"), []
    launch = chromium.browser_type.launch_persistent_context
    context = launch(profile, executable_path=program(), args=FLAGS, viewport={"width": 768, "height": 1024})
    tablet = Watched(context.new_page(), address)
    sign_in_as(tablet, "coordinator", f"/visit-day/{visit}")
    tablet.page.wait_for_selector("#day[data-ready=yes]")
    tablet.page.wait_for_function("() => caches.match('/visit-day/shell').then(Boolean)")
    for number, slot in enumerate(slots, 1):
        tap(tablet, "start")
        logs.append(tmp_path / f"session-{number}.csv")
        if slot["detail"]:
            run_on_the_tablet(client, policies[slot["detail"]], number, logs[-1])
        else:
            conventional(logs[-1])
        if number == 1:
            shot(tablet, "2-running")
        sent(tablet)
        if number == 2:
            context.set_offline(True)
        rate(tablet, 6 + number, f"2.{number}")
        if number == 2:
            kept(tablet, 5)
            shot(tablet, "3-no-connection")
            tablet.page.reload()
            tablet.page.wait_for_selector("section[data-state=running]")
        tablet.page.wait_for_selector("[data-act='gait-none'][aria-pressed=true]")  # what is shown as entered is on the disk
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
    shot(tablet, "5-day-complete")
    context.close()
    entries = client.get(f"/api/v1/visits/{visit}/day/entries").json()["items"]
    assert [e["kind"] for e in entries].count("rating") == 3
    assert {e["entered_by"] for e in entries} == {"coordinator@clinic.example"}
    assert len({e["uuid"] for e in entries}) == len(entries) == 3 * 9 + 1

    # the logs come back and become sessions
    coordinator = window(1280, 900)
    sign_in_as(coordinator, "coordinator", f"/participants/{enrolled}/upload?visit=2")
    coordinator.page.set_input_files("input[type=file]", [str(log) for log in logs])
    coordinator.page.click("form[data-upload] button.primary")
    coordinator.page.wait_for_function("() => document.querySelectorAll('[data-upload-list] li .badge').length >= 3", timeout=60_000)
    coordinator.open(f"/visits/{visit}/slots")
    if coordinator.page.is_visible("[name=other_day]"):
        coordinator.page.check("[name=other_day]")
    coordinator.page.click("form[action$='/slots/confirm'] button.primary")
    coordinator.page.wait_for_selector(".note:has-text('Confirmed')")
    shot(coordinator, "6-planned-and-done")
    sessions = client.get(f"/api/v1/visits/{visit}/sessions").json()["items"]
    ran = sorted((s["controller"], s["policy_id"] or 0) for s in sessions)
    assert ran == [("cdbs", 0), *sorted(("rl", policy) for policy in policies.values())]
    qocs = [client.get(f"/api/v1/sessions/{s['id']}/qoc").json() for s in sessions]
    assert sorted((q["rating"], q["grasp_hz"]) for q in qocs) == [(7, 2.1), (8, 2.2), (9, 2.3)]

    # the engineer starts the next generation
    engineer.open(f"/participants/{enrolled}/jobs")
    engineer.page.select_option("[name=preset]", "quick")
    engineer.page.click("button:has-text('Start job')")
    engineer.page.wait_for_url("**/jobs/*")
    shot(engineer, "8-next-generation")
    assert engineer.errors + coordinator.errors == []
