"""Page of a job with a fit: the curves of every member, how it ended, and its parameters in words."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_args

from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.evaluation.estimates.compute import evaluate_method, fit_dlsm
from app.learning.schemas import Aim, Anchor, Preset
from app.pipeline.charts import job_curves
from app.pipeline.pages import VALUE_NAMES
from app.platform.jobs import StepReport, engine, repository
from app.tables.jobs import Job, JobEvent, JobStep
from ml.ope.dlmm import DlmmConfig
from tests.app.evaluation.estimates.test_compute import buffer_of, call, sessions


def told(step: str, x: float, **values: float) -> JobEvent:
    return JobEvent(kind="points", step_key=step, data={"points": [{"x": x, "values": values}]})


def test_the_curves_of_a_job_have_a_line_for_every_member_and_identities_of_their_own() -> None:
    job = Job(steps=[JobStep(key=f"fit/{k}", title=f"Member {k + 1}") for k in range(2)])
    events = [told(f"fit/{k}", x, dlsm_loss=10.0 - k - x, dlsm_held_out_score=2.0 + k) for k in range(2) for x in (25.0, 50.0)]
    events += [told("fit/0", 50.0, dlsm_loss=7.0, some_new_curve=1.0)]  # resumed: the last point of an x counts
    charts = {c.id: c for c in job_curves(job, events)}
    assert list(charts) == ["job-dlsm-loss", "job-dlsm-held-out-score", "job-some-new-curve"]
    lines = {line["name"]: (line["x"], line["y"]) for line in charts["job-dlsm-loss"].figure["data"]}
    assert lines == {"Member 1": ([25.0, 50.0], [-15.0, 7.0]), "Member 2": ([25.0, 50.0], [-16.0, -41.0])}
    assert charts["job-dlsm-held-out-score"].title == "DLSM: score on held-out sessions"
    assert charts["job-some-new-curve"].title == "Some new curve"


def test_a_members_fit_tells_loss_held_out_score_and_how_it_ended(db: Session, tmp_path: Path) -> None:
    messages: list[dict[str, Any]] = []
    result = fit_dlsm(call(db, buffer_of(sessions()), member=1), tmp_path, StepReport(messages.append, interval_s=0.0))
    points = [p for m in messages for p in m.get("points", [])]
    assert len(points) == result["checks"]
    assert all({"dlsm_loss", "dlsm_held_out_score"} <= set(p["values"]) for p in points[1:])
    assert "dlsm_held_out_score" in points[0]["values"]  # where a model that has learnt nothing yet is checked too, it has no loss
    assert [p["x"] for p in points] == sorted(p["x"] for p in points)
    (log,) = [m["log"] for m in messages if "log" in m]
    found = re.fullmatch(
        r"member 2 (?:ran to its last update|was stopped early, at update (\d+) of (\d+)): the best held-out score, (\S+), was that of "
        r"update (\d+), which is kept",
        log,
    )
    assert found is not None, log
    best = min(points, key=lambda p: p["values"]["dlsm_held_out_score"])
    assert int(found[4]) == best["x"]
    assert float(found[3]) == float(f"{best['values']['dlsm_held_out_score']:.4g}")
    if found[1] is not None:
        assert int(found[1]) == points[-1]["x"] < int(found[2])


def test_the_page_names_methods_in_words(client: TestClient, upload: Callable[..., int]) -> None:
    upload("random")
    asked = {"kind": "pipeline", "preset": "quick", "methods": ["wis", "dual_dice"]}
    job = client.post("/api/v1/participants/P1/jobs", json=asked).json()["id"]
    page = client.get(f"/jobs/{job}").text
    assert "Weighted importance sampling, DualDICE" in page
    asked_for = page[page.index("Asked for</h2>") :]
    assert "dual_dice" not in asked_for
    for name, value in (("Size", "quick: for a first look"), ("Critics see past amplitudes", "yes"), ("Seed", "0")):
        assert f"<dt>{name}</dt><dd>{value}</dd>" in asked_for


def test_the_page_says_when_no_worker_of_the_newest_version_lives(client: TestClient, db: Session, upload: Callable[..., int]) -> None:
    upload("random")
    job = client.post("/api/v1/participants/P1/jobs", json={"kind": "pipeline", "preset": "quick"}).json()["id"]
    repository.beat(db, "here-0", "here", 1, engine.PROTOCOL, "x")
    db.commit()
    assert "newest version" not in client.get(f"/jobs/{job}").text
    repository.set_protocol(db, [job], engine.PROTOCOL + 1)
    db.commit()
    page = client.get(f"/jobs/{job}").text
    assert "No worker of the newest version is running" in page
    assert "betaloop take-back-jobs" in page


def test_every_answer_to_a_question_of_the_form_has_its_words() -> None:
    assert {name: set(words) for name, words in VALUE_NAMES.items()} == {
        "aim": set(get_args(Aim)), "anchor": set(get_args(Anchor)), "preset": set(get_args(Preset))
    }  # fmt: skip


def test_members_that_learn_one_after_the_other_have_a_curve_each(db: Session, tmp_path: Path) -> None:
    messages: list[dict[str, Any]] = []
    asked = call(db, buffer_of(sessions()), method="dlmm", preset="full")
    assert "estimates" in evaluate_method(asked, tmp_path, StepReport(messages.append, interval_s=0.0))
    events = [JobEvent(kind="points", step_key="estimate/dlmm", data=m) for m in messages if "points" in m]
    curve = next(c for c in job_curves(Job(steps=[JobStep(key="estimate/dlmm", title="DLMM")]), events) if c.id == "job-dlmm-loss")
    members = DlmmConfig().members
    assert [line["name"] for line in curve.figure["data"]] == [f"DLMM \u00b7 {k + 1}" for k in range(members)]
    assert curve.columns[1] == "Share of the fit (%)"
    for line in curve.figure["data"]:
        assert line["x"] == sorted(line["x"])
        assert 0 <= line["x"][0] < 50
        assert line["x"][-1] <= 100
