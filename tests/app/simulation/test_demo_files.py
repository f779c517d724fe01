"""Files that the demo stores with the package: small, whole, and read as written; and how its loader goes on."""

from __future__ import annotations

import datetime as dt
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from app.platform.errors import BetaloopError
from app.simulation.demo.content import LINES, Participant
from app.simulation.demo.data import DAY_WITH_POLICIES, FOLDER, MOST_BYTES, read, write
from app.simulation.demo.loader import LoadFailed, State, run_all
from app.simulation.demo.making import STUDY
from app.simulation.demo.study import TESTED_VISITS, demo_visits
from ml.policies.onnx_policy import OnnxPolicy
from ml.population import PARTICIPANTS

TODAY = dt.date(2026, 3, 2)


def test_the_files_are_small_and_hold_every_session_and_tested_policy() -> None:
    assert sum(path.stat().st_size for path in FOLDER.iterdir()) <= MOST_BYTES
    assert {path.stem for path in FOLDER.glob("*.zip")} == set(STUDY)
    for code in STUDY:
        story = read(code)
        policies = {p.name: p for g in story.generations for p in g.policies}
        assert story.seed == STUDY[code].seed
        assert {name for g in story.generations for name in g.tested} <= set(policies)
        for policy in policies.values():
            assert OnnxPolicy(policy.onnx, 10).act(np.full((1, 10), 1.0)).shape == (1,)
            assert (policy.kind == "distilled") == (policy.teacher is not None)
        assert len(story.sessions) == TESTED_VISITS.get(code, 0) * len(DAY_WITH_POLICIES)
        cdbs_ma = PARTICIPANTS[code].cdbs_amplitude_ma
        for session in story.sessions:
            assert session.beta.size == session.amplitude_ma.size == 30 * DAY_WITH_POLICIES[session.position - 1].minutes
            assert 0 <= session.amplitude_ma.min() <= session.amplitude_ma.max() <= cdbs_ma + 1e-9


def test_a_story_that_is_written_again_has_the_same_bytes(tmp_path: Path) -> None:
    for code in STUDY:
        assert write(tmp_path, read(code)).read_bytes() == (FOLDER / f"{code}.zip").read_bytes()


def test_sessions_of_policies_did_what_the_stored_policies_ask_for() -> None:
    """The stored amplitudes are those of the stored networks over the stored beta, rounded to what the device delivers."""
    for code in TESTED_VISITS:
        story = read(code)
        policies = {p.name: OnnxPolicy(p.onnx, 10) for g in story.generations for p in g.policies}
        cdbs_ma = PARTICIPANTS[code].cdbs_amplitude_ma
        for session in story.sessions:
            if session.policy is not None:
                beta = np.concatenate([session.lead_beta, session.beta])
                windows = np.stack([beta[k : k + 10] for k in range(session.beta.size)])
                asked = policies[session.policy].act(windows) * cdbs_ma
                # beta is stored with four decimals
                assert np.abs(asked - session.amplitude_ma).max() <= 0.05 + 0.01, (code, session.visit, session.position)


def test_the_next_visits_wait_for_their_day() -> None:
    days = {code: [v.date for v in demo_visits(code, TODAY)] for code in PARTICIPANTS}
    assert {code: len(dates) for code, dates in days.items()} == {"P1": 4, "P2": 4, "P3": 7, "P4": 7}
    assert days["P2"][-1] == TODAY + dt.timedelta(days=1)
    assert all(dates[-2] < TODAY < dates[-1] for dates in days.values())


def test_every_step_of_the_demo_has_a_name_of_its_own(tmp_path: Path) -> None:
    state = State.at(tmp_path / "demo.json", TODAY)
    names = [name for code, line in LINES.items() for name, _ in line(Participant(code, state, people=None))]  # type: ignore[arg-type]
    assert len(set(names)) == len(names) > 150


def test_a_loader_that_was_stopped_goes_on_where_it_was(tmp_path: Path) -> None:
    path, did = tmp_path / "demo.json", []

    def line(code: str, fails_at: int | None) -> list[Any]:
        def do(k: int) -> None:
            if k == fails_at:
                raise LoadFailed("away")
            did.append(f"{code}{k}")

        return [(f"{code} {k}", lambda k=k: do(k)) for k in range(4)]

    with pytest.raises(BetaloopError, match="away"):
        run_all(State.at(path, TODAY), [line("a", 2)], lambda done, total: None)
    later = State.at(path, TODAY + dt.timedelta(days=9))
    assert (later.begun, later.done) == (TODAY, {"a 0", "a 1"})
    told: list[tuple[int, int]] = []
    run_all(later, [line("a", None), line("b", None)], lambda done, total: told.append((done, total)))
    assert sorted(did) == ["a0", "a1", "a2", "a3", "b0", "b1", "b2", "b3"]
    assert max(told) == (8, 8)


def test_a_demo_of_another_version_is_refused(tmp_path: Path) -> None:
    path, codes = tmp_path / "demo.json", ["P1", "P2", "P3", "P4"]
    path.write_text(json.dumps({"begun": "2026-01-05", "loaded": codes, "jobs": dict.fromkeys(codes, "x")}))
    with pytest.raises(LoadFailed, match="begun by another version"):
        State.at(path, TODAY)
