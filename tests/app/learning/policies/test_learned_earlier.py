"""Policies that were learned earlier come in with where they come from, where the sessions here are those that they were learned on."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.learning.learned_earlier import Learned, add_learned
from app.learning.policies import constant_onnx
from app.learning.snapshots import take_snapshot
from app.learning.trajectories import read_buffer
from app.platform.errors import Conflict, Invalid
from app.study import repository as study
from app.tables.learning import BufferSnapshot
from app.tables.participants import Participant
from ml.trajectories import ReplayBuffer
from tests.app.conftest import Upload


def learned(name: str = "rl-01", amplitude: float = 0.5, **changes: Any) -> Learned:
    given: dict[str, Any] = {
        "name": name,
        "kind": "trained",
        "algorithm": "rebrac",
        "teacher": None,
        "parent": None,
        "config": {"seed": 7, "updates": 10},
        "metrics": {"parameters": 1},
        "onnx": constant_onnx(amplitude, 10),
        "code_version": "0.0.1",
    }
    return Learned(**(given | changes))


@pytest.fixture
def here(upload: Upload, db: Session) -> tuple[Participant, BufferSnapshot, ReplayBuffer]:
    for controller in ("random", "cdbs", "random"):
        upload(controller)
    participant = study.participant_by_code(db, "P1", SYSTEM)
    snapshot = take_snapshot(db, participant, SYSTEM)
    return participant, snapshot, read_buffer(snapshot.file_sha256)


def test_a_policy_and_its_student_keep_where_they_come_from(here: Any, db: Session) -> None:
    participant, snapshot, buffer = here
    first = add_learned(db, participant, snapshot, buffer, learned(), SYSTEM)
    tuned = add_learned(db, participant, snapshot, buffer, learned("rl-02", 0.6, parent="rl-01"), SYSTEM)
    small = add_learned(db, participant, snapshot, buffer, learned("rl-01-small", 0.5, kind="distilled", teacher="rl-01"), SYSTEM)
    assert (first.kind, first.snapshot_id, first.seed, first.code_version) == ("trained", snapshot.id, 7, "0.0.1")
    assert (tuned.parent_id, small.teacher_id, small.kind) == (first.id, first.id, "distilled")
    again = add_learned(db, participant, snapshot, buffer, learned(), SYSTEM)
    assert again.id == first.id
    with pytest.raises(Conflict, match="another policy 'rl-01'"):
        add_learned(db, participant, snapshot, buffer, learned(amplitude=0.9), SYSTEM)


def changed(buffer: ReplayBuffer, place: int, **values: Any) -> ReplayBuffer:
    sessions = list(buffer.sessions)
    sessions[place] = replace(sessions[place], **values)
    return replace(buffer, sessions=tuple(sessions))


def test_a_policy_of_other_sessions_is_refused_with_what_differs(here: Any, db: Session) -> None:
    participant, snapshot, buffer = here
    first = buffer.sessions[0]
    others = {
        "its session 1 has another beta": changed(buffer, 0, beta=first.beta * 1.001),
        "its session 2 has another amplitude": changed(buffer, 1, amplitude=buffer.sessions[1].amplitude - 0.01),
        "its session 3 has another outcome": changed(buffer, 2, qoc=replace(first.qoc, rating=1)),
        "its session 1 has another visit": changed(buffer, 0, visit=2),
        "its session 1 has another controller": changed(buffer, 0, controller="cdbs"),
        "it holds 3 sessions and not 2": replace(buffer, sessions=buffer.sessions[:2]),
        "the settings are others": replace(buffer, settings=replace(buffer.settings, xi_beta=9.0)),
    }
    for reason, other in others.items():
        with pytest.raises(Invalid, match=reason):
            add_learned(db, participant, snapshot, other, learned(), SYSTEM)
    rounded = changed(buffer, 0, beta=first.beta * (1 + 1e-9), session_id=77, policy_id=None)
    assert add_learned(db, participant, snapshot, rounded, learned(), SYSTEM).name == "rl-01"


def test_a_file_that_is_no_policy_and_an_unknown_teacher_are_refused(here: Any, db: Session) -> None:
    participant, snapshot, buffer = here
    with pytest.raises(Invalid, match="cannot be run"):
        add_learned(db, participant, snapshot, buffer, learned(onnx=b"no network"), SYSTEM)
    with pytest.raises(Invalid, match="made from 'rl-09', which participant P1 does not have"):
        add_learned(db, participant, snapshot, buffer, learned(kind="distilled", teacher="rl-09"), SYSTEM)
