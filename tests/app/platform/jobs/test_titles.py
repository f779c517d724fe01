"""Steps are called in words without methods where anybody reads them, and the time that is left comes with every sign of progress."""

from __future__ import annotations

import re
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest

from app.platform.jobs.stream import describe, shown
from app.platform.jobs.titles import failure, numbered, plain_words, reason
from app.tables.jobs import Job, JobEvent, JobStatus, JobStep
from ml.ope.registry import methods
from tests.app.words import methods_named

ROOT = Path(__file__).resolve().parents[4]


def test_titles_of_this_and_of_earlier_versions_name_no_method() -> None:
    assert plain_words("Take a buffer snapshot") == "Pin the sessions to learn from"
    assert plain_words("Train policies 1 to 3 (TD3+BC)") == "Train policies 1 to 3"
    assert plain_words("Train policy 2 (learning rate 0.0001): update 3 of 4") == "Train policy 2: update 3 of 4"
    fit = "Fit the deep latent sequential model, member 2: fitting the deep latent sequential model"
    assert plain_words(fit) == "Fit model 2 of the sessions: fitting the model"
    estimates = [f"Estimate every policy: {m.name}" for m in methods()]
    assert len(estimates) >= 6
    assert {plain_words(f"{title}: rolling out policies") for title in estimates} == {"Estimate every policy: rolling out policies"}
    assert numbered(["Take a buffer snapshot", *estimates[:2]]) == [
        "Pin the sessions to learn from", "Estimate every policy, method 1 of 2", "Estimate every policy, method 2 of 2",
    ]  # fmt: skip


def test_no_message_of_a_computation_names_a_method_where_it_is_shown() -> None:
    told = [
        message
        for path in [*(ROOT / "ml").rglob("*.py"), *(ROOT / "app/learning").rglob("*.py"), *(ROOT / "app/evaluation").rglob("*.py")]
        for message in re.findall(r'\b(?:report|report\.progress)\([^"\n]*?, f?"([^"]+)"', path.read_text())
    ]
    assert len(told) >= 20
    named = {m: methods_named(plain_words(m)) for m in told}
    assert {m: words for m, words in named.items() if words} == {}
    assert [m for m in told if re.search("deep latent|linear model|value function|density ratio", plain_words(m))] == []


@pytest.mark.parametrize(("left", "words"), [(130.0, "about 3 min left"), (None, "time left not known yet")])
def test_an_event_of_progress_tells_the_time_left_in_words(left: float | None, words: str) -> None:
    data = {"progress": 0.5, "job_progress": 0.4, "seconds_left": left, "message": "fitting the linear model"}
    event = JobEvent(id=1, kind="progress", step_key="fit/0", data=data, at=datetime.now(UTC))
    assert shown(event)["data"] == data | {"time_left": words, "message": "fitting the model"}
    earlier = JobEvent(id=1, kind="progress", step_key="fit/0", data={"progress": 0.5, "message": ""}, at=datetime.now(UTC))
    assert "time_left" not in shown(earlier)["data"], "an event that an earlier version stored tells none"


def test_the_state_of_a_job_tells_the_time_left_in_words() -> None:
    begun = datetime.now(UTC) - timedelta(seconds=110)
    step = JobStep(key="fit/0", title="Fit", status=JobStatus.RUNNING, progress=0.5, message="fitting the linear model", weight=1.0)
    message = "Take a buffer snapshot"
    job = Job(id="4f", kind="train", status=JobStatus.RUNNING, progress=0.5, message=message, started_at=begun, steps=[step])
    state = describe(job)
    assert (state["time_left"], state["message"]) == ("about 2 min left", "Pin the sessions to learn from")
    assert state["steps"][0]["message"] == "fitting the model"


def test_a_failure_is_told_in_our_own_words_or_by_its_step() -> None:
    titles = {"fit/0": "Fit model 1 of the sessions"}
    raw = "ValueError: the DLSM needs at least 4 sessions"
    assert failure(f"Step fit/0 failed: {raw}", titles) == "A step failed: Fit model 1 of the sessions."
    assert failure(f"Step fit/0 failed: {raw}") == failure("Step fit/9 failed: KeyError", titles) == "A step failed."
    assert failure(raw) == "It failed for a reason that is told to engineers."
    own = "The policies cannot be trained: the training diverged; lower the learning rates."
    assert failure(f"Step train/0 failed: {own}", titles) == reason(own) == own
    nested = f"Which tested policy did best cannot be told: Step fit/0 failed: {raw}. Start a 'pipeline' that names the policies."
    assert failure(nested, titles) == "It failed for a reason that is told to engineers."
    assert [reason(text) for text in (raw, "AssertionError", nested, "")] == ["", "", "", ""]
    assert failure("The worker died 4 times while it ran this job, so the job was given up.").startswith("The worker died")
