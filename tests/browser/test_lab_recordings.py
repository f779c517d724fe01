"""A lab with one XDF per session and a sheet of ratings, from its folder to a ranking without a line of code.

Each XDF has a local field potential, a gyroscope at the wrist, and markers of the stimulation in the lab's own words.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from fastapi.testclient import TestClient
from typer.testing import CliRunner

from app.cli import app
from tests.app.conftest import worker
from tests.browser.conftest import Watched
from tests.ml.formats.peers.xdf import Stream, write

__all__ = ["worker"]
pytestmark = [pytest.mark.browser, pytest.mark.slow]

STEPS = 90
SESSIONS = (("random", 0), ("random", 1), ("random", 2), ("cdbs", 3), ("cdbs", 4))
RATINGS = (6, 7, 5, 8, 8)
"""The lab's sheet, a row per session."""


def recording(path: Path, controller: str, number: int) -> Path:
    """Write a session: beta falls with the amplitude, and so does a tremor of 4 cm; each amplitude is announced as `Stufe 1.5 mA`."""
    rng = np.random.default_rng(number)
    doses = np.full(STEPS, 3.0) if controller == "cdbs" else rng.integers(2, 7, STEPS // 3).repeat(3) * 0.5
    t = np.arange(2 * STEPS * 250) / 250
    beta = (8 - 2 * doses[(t // 2).astype(int).clip(max=STEPS - 1)]) * np.sin(2 * np.pi * 20 * t)
    lfp = Stream("LFP", "LFP", 250.0, 100.0 + t, (beta + rng.normal(0, 1, t.size))[:, None], ["LFP L 0-2"], ["uV"])
    m = np.arange(2 * STEPS * 50) / 50
    size_m = 0.02 * (1 - doses[(m // 2).astype(int).clip(max=STEPS - 1)] / 4)
    turned = np.degrees(2 * np.pi * 5 * size_m / 0.15 * np.cos(2 * np.pi * 5 * m))
    gyroscope = Stream("Wrist", "Gyroscope", 50.0, 100.0 + m, turned[:, None], ["gyro x L"], ["deg/s"])
    changes = [0, *(np.flatnonzero(np.diff(doses)) + 1)]
    marks = Stream(
        "Markers", "Markers", 0, 100.02 + 2.0 * np.array(changes), [f"Stufe {doses[k]:g} mA" for k in changes], form="string", per_chunk=1
    )
    write(path, [lfp, gyroscope, marks], date=f"2026-03-02T{10 + number}:00:00+0000")
    return path


def test_a_lab_s_recordings_and_ratings_become_a_ranking(
    window: Callable[..., Watched],
    client: TestClient,
    participant_code: str,
    worker: None,
    tmp_path: Path,
) -> None:
    home = f"/participants/{participant_code}"
    settings = {"design": "stratified", "cdbs_amplitude_ma": 3.0, "xi_beta": 3.0, "beta_unit": "uV", "beta_source": "time_domain"}
    assert client.put(f"/api/v1{home}/settings", json={"settings": settings}).status_code == 200
    study = tmp_path / "study"
    study.mkdir()
    for number, (controller, hour) in enumerate(SESSIONS):
        recording(study / f"{number}.xdf", controller, hour)
    rows = [f"{participant_code},1,{c},{n}.xdf,{RATINGS[n]}" for n, (c, _) in enumerate(SESSIONS)]
    (tmp_path / "sheet.csv").write_text("\n".join(["participant,visit,controller,file,rating", *rows]), "utf-8")
    done = CliRunner().invoke(app, ["import", str(study), "--study", str(tmp_path / "sheet.csv")])
    assert done.exit_code == 0, done.output
    (visit,) = client.get(f"/api/v1{home}/visits").json()["items"]
    kept = sorted(client.get(f"/api/v1/visits/{visit['id']}/sessions").json()["items"], key=lambda s: s["started_at"])
    ids = [s["id"] for s in kept]
    assert [s["controller"] for s in kept] == [c for c, _ in SESSIONS]
    lab = window(1280, 900)
    lab.signed_in()

    # the lab's words and the gyroscope's lever are explained once, for every file of the upload
    lab.open(f"/sessions/{ids[0]}")
    lab.page.click("text=Markers and channels")
    lab.page.select_option("select[name^=means]", "stated")
    lab.page.fill("input[name^=lever]", "15")
    lab.page.click("button:has-text('State for the study')")
    lab.page.wait_for_selector(".note.good:has-text('Stated for the study')")

    # the recordings begin with their sessions: the page says from where on they are learned from
    lab.open(f"/sessions/{ids[0]}")
    assert lab.page.locator(".note:has-text('Learning starts within the session')").count() == 1
    outcomes = [client.get(f"/api/v1/sessions/{i}/qoc").json() for i in ids]
    assert [o["rating"] for o in outcomes] == list(RATINGS)
    assert all(o["tremor_percent"] is not None for o in outcomes), [o["tremor_percent"] for o in outcomes]

    # from the jobs page to the ranking
    lab.open(f"{home}/jobs")
    lab.page.select_option("[name=kind]", "pipeline")
    lab.page.select_option("[name=preset]", "quick")
    lab.page.click("summary:has-text('Algorithms, methods, seed')")
    for name, value in (("count", "2"), ("updates", "60"), ("seed", "3")):
        lab.page.fill(f"[name={name}]", value)
    lab.page.check("[name=methods][value=posterior]")
    lab.page.click("form:has([name=kind]) button.primary")
    lab.page.wait_for_url("**/jobs/*")
    job = lab.page.url.rsplit("/", 1)[1].partition("?")[0]
    lab.page.goto("about:blank")  # the page of a job loads itself again when the job ends
    done = client.get(f"/api/v1/jobs/{job}").json()
    for _ in range(800):
        if done["finished_at"]:
            break
        lab.page.wait_for_timeout(500)
        done = client.get(f"/api/v1/jobs/{job}").json()
    assert done["status"] == "succeeded", done["error"]
    lab.open(f"{home}/ranking")
    assert lab.page.locator("table tbody tr").count() >= 2
    assert lab.errors == []
    assert lab.foreign == []
