"""The demo as a user meets it: begun from nothing, killed in the midst, continued, and each page of the tour has its content."""

from __future__ import annotations

import html
import json
import os
import re
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx2 as httpx
import psutil
import psycopg
import pytest

from app.platform.embedded.server import EmbeddedPostgres
from app.settings import get_settings
from tests.ports import free_port

ROOT = Path(__file__).resolve().parents[3]
pytestmark = [pytest.mark.slow, pytest.mark.timeout(1500)]
ENOUGH_S = 600


@dataclass
class Demo:
    """The running demo: where it is, who looks at it, and what it took to fill."""

    data: Path
    url: str
    browser: httpx.Client
    before_kill: set[str]
    filled_s: float

    def page(self, path: str) -> str:
        answer = self.browser.get(path)
        assert answer.status_code == 200, f"{path}: {answer.status_code} {answer.text[:500]}"
        return html.unescape(re.sub(r"\s+", " ", re.sub(r"<(script|style).*?</\1>", " ", answer.text, flags=re.S)))

    def text(self, path: str) -> str:
        return re.sub(r"\s+", " ", re.sub(r"<[^>]+>", " ", self.page(path)))

    def get(self, path: str) -> Any:
        answer = self.browser.get(f"/api/v1{path}")
        assert answer.status_code == 200, answer.text
        return answer.json()

    def visits(self, code: str) -> dict[int, int]:
        return {v["number"]: v["id"] for v in self.get(f"/participants/{code}/visits?limit=200")["items"]}

    def confirmed(self, visit_id: int) -> int:
        rows = self.get(f"/visits/{visit_id}/sessions?limit=200")["items"]
        return sum(row["status"] == "confirmed" for row in rows)

    def rows(self, query: str) -> list[Any]:
        found = EmbeddedPostgres(self.data / "postgres", server_user=get_settings().server_user).url("betaloop")
        with psycopg.connect(found.replace("+psycopg", "")) as connection:
            return connection.execute(query).fetchall()


def start(data: Path, port: int) -> subprocess.Popen[bytes]:
    kept = {"BETALOOP_SERVER_USER", "BETALOOP_JOB_NICENESS"}
    env = {k: v for k, v in os.environ.items() if not k.startswith("BETALOOP_") or k in kept}
    env |= {"BETALOOP_DATA_DIR": str(data), "PYTHONPATH": str(ROOT), "OMP_NUM_THREADS": "1"}
    with (data / "said.txt").open("ab") as out:
        command = [sys.executable, "-m", "app.cli", "demo", "--port", str(port)]
        return subprocess.Popen(command, cwd=ROOT, stdout=out, stderr=out, env=env)


def wait(data: Path, process: subprocess.Popen[bytes], reached: Callable[[], bool]) -> None:
    deadline = time.monotonic() + ENOUGH_S
    while not reached():
        assert process.poll() is None, (data / "said.txt").read_text()
        assert time.monotonic() < deadline, (data / "said.txt").read_text()
        time.sleep(0.1)


def done(data: Path) -> set[str]:
    path = data / "demo.json"
    return set(json.loads(path.read_text())["done"]) if path.exists() else set()


@pytest.fixture(scope="module")
def demo() -> Iterator[Demo]:
    """Begun, its loader killed in the midst, begun again; then it is left to load to its end."""
    data, port = Path("/tmp") / f"betaloop-demo-{os.getpid()}-{os.urandom(4).hex()}", free_port()
    data.mkdir()
    data.chmod(0o711)
    said = data / "said.txt"
    process = start(data, port)
    try:
        wait(data, process, lambda: len(done(data)) >= 30)
        (loader,) = [p for p in psutil.Process(process.pid).children() if "app.simulation.demo.loader" in p.cmdline()]
        loader.send_signal(signal.SIGKILL)
        assert process.wait(300) != 0
        assert "goes on where it was" in said.read_text()
        before = done(data)
        said.write_text("")
        process = start(data, port)
        wait(data, process, lambda: "password" in said.read_text())
        up = time.monotonic()
        wait(data, process, lambda: "Every page has its content" in said.read_text())
        filled = time.monotonic() - up
        url = f"http://127.0.0.1:{port}"
        word = (data / "secrets" / "demo-password").read_text().strip()
        with httpx.Client(base_url=url, timeout=120, follow_redirects=True) as browser:
            answer = browser.post("/sign-in", data={"email": "admin@demo.example", "password": word})
            assert answer.status_code == 200, answer.text
            yield Demo(data, url, browser, before, filled)
    finally:
        if process.poll() is None:
            process.terminate()
            process.wait(90)
        EmbeddedPostgres(data / "postgres", server_user=get_settings().server_user).remove()
        shutil.rmtree(data)


def test_the_first_screen_says_what_one_looks_at_and_offers_five_questions(demo: Demo) -> None:
    page = demo.page("/")
    assert "This is the demo" in page
    assert "simulated and not fitted to patients" in page
    card = page[page.index('id="demo"') : page.index("</section>", page.index('id="demo"'))]
    links = re.findall(r'<a href="([^"]+)">', card)
    assert len(links) == 5
    for link in links:
        demo.page(link)


def test_what_was_done_before_the_kill_is_not_done_again(demo: Demo) -> None:
    assert demo.before_kill < done(demo.data)
    twice = demo.rows("select visit_id, ordinal, count(*) from session group by 1, 2 having count(*) > 1")
    assert twice == []
    counts = {code: sum(map(demo.confirmed, demo.visits(code).values())) for code in ("P1", "P2", "P3", "P4")}
    assert counts == {"P1": 18, "P2": 18, "P3": 60, "P4": 60}
    assert len(demo.visits("P3")) == 7
    dates = [v["date"] for v in demo.get("/participants/P2/visits?limit=200")["items"]]
    begun = json.loads((demo.data / "demo.json").read_text())["begun"]
    assert max(dates) > begun > sorted(dates)[-2]


def test_sessions_outcomes_visits_and_plans_came_through_the_door(demo: Demo) -> None:
    for entity in ("participant", "visit", "session", "qoc", "upload", "plan", "adverse_event", "data_query", "buffer_gate_decision"):
        found = demo.rows(f"select distinct actor, request_id is null from audit_event where entity = '{entity}' and action = 'insert'")
        assert found, entity
        assert {actor for actor, _ in found} <= {f"{who}@demo.example" for who in ("admin", "clinician", "engineer")}, entity
        assert not any(without for _, without in found), entity


def test_the_policies_are_those_that_were_learned_on_these_sessions(demo: Demo) -> None:
    for code in ("P3", "P4"):
        rows = demo.get(f"/participants/{code}/policies?limit=200")["items"]
        learned = [p for p in rows if p["kind"] in ("trained", "distilled")]
        assert {p["kind"] for p in learned} == {"trained", "distilled"}
        assert any(p["parent_id"] for p in learned), "no generation went on from a tested policy"
        assert all(p["snapshot_id"] for p in learned)


@pytest.mark.parametrize("code", ["P3", "P4"])
def test_the_analyses_have_their_content(demo: Demo, code: str) -> None:
    at = f"/participants/{code}"
    analyses = demo.text(f"{at}/analyses")
    verdict = {
        "P3": "RL is non-inferior to cDBS on grasp, rating and tremor and saves 32 % of the stimulation energy",
        "P4": "Inconclusive over 4 visits: RL is not shown to be non-inferior on tremor",
    }
    assert verdict[code] in analyses
    assert "exploratory" in analyses
    paper = demo.text(f"{at}/analyses/paper")
    for controller in ("RL", "Distilled RL"):
        assert re.search(rf" {controller} 12 [\d.]+ [\d.]+ [\d.]+ −?[\d.]+ −?[\d.]+ −?[\d.]+ [\d.]+ [\d.]+ ", paper), "no p-values"
    calibration = demo.get(f"{at}/calibration")
    assert calibration["missing"] is None
    assert {p["visit"] for p in calibration["policies"] if p["reference"] is None} == {3, 4, 5, 6}
    assert demo.get(f"{at}/calibration")["metrics"]
    energy = demo.text(f"{at}/analyses/energy")
    assert "No learned controller has run" not in energy
    assert 'class="empty"' not in demo.page(f"{at}/analyses/energy")
    assert "rl-" in demo.text(f"{at}/next-generation")


def test_the_study_wide_pages_have_their_content(demo: Demo) -> None:
    for code in ("P3", "P4"):
        assert re.search(rf"{code} \d+ 120 24", demo.text("/energy-saved")), code
    assert "Distilled RL" in demo.text("/trial-time")
    assert "P4" in demo.text("/analyses")
    assert "upload" in demo.text("/audit")
    assert "paraesthesia" in demo.text("/participants/P3/adverse-events").lower()
    queries = demo.text("/participants/P4/data-queries")
    assert "Was this rating given" in queries
    assert "answered" in queries.lower()


def test_planned_and_done_agree(demo: Demo) -> None:
    for code in ("P3", "P4"):
        for number, visit in demo.visits(code).items():
            if 3 <= number <= 6:
                slots = demo.get(f"/visits/{visit}/slots")
                assert (slots["missing"], slots["planned"]) == ([], 12), (code, number)
                assert all(row["confirmed"] for row in slots["rows"] if row["position"] is not None), (code, number)


def test_p2s_clinic_day_is_ready_to_walk(demo: Demo) -> None:
    visit = demo.visits("P2")[4]
    plan = demo.get(f"/visits/{visit}/plan")
    assert (plan["status"], plan["signature_state"]) == ("approved", "stands")
    assert {s["controller"] for s in plan["sessions"]} == {"rl", "cdbs", "distilled", "no_dbs"}
    with_bundle = [s for s in plan["sessions"] if s["controller"] != "no_dbs"]
    taken = demo.rows(
        "select count(distinct plan_item_id) from bundle_release r join plan_item i on i.id = r.plan_item_id "
        f"where i.plan_id = {plan['id']}"
    )
    assert taken == [(len(with_bundle),)]
    assert demo.get("/participants/P2/margins/locks")
    demo.page(f"/visit-day/{visit}")


@pytest.mark.parametrize(
    "path",
    [
        "/", "/energy-saved", "/analyses", "/trial-time", "/jobs", "/audit",
        *(f"/participants/{code}{tail}" for code in ("P3", "P4") for tail in (
            "", "/visits", "/policies", "/ranking", "/calibration", "/plans", "/jobs", "/buffer-gate", "/next-generation",
            "/analyses", "/analyses/paper", "/analyses/energy", "/settings", "/margins",
        )),
    ],
)  # fmt: skip
def test_no_page_of_the_tour_is_empty(demo: Demo, path: str) -> None:
    page = demo.page(path)
    assert 'class="empty"' not in page, re.findall(r'class="empty">(.*?)</div>', page)
