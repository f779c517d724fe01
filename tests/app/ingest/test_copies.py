"""The same minutes of a device count once, in whatever set of files they come, and the fuller copy counts."""

from __future__ import annotations

import io
import json
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select, text
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.ingest.proposals.copies import Relation, Rows, relation
from app.learning.snapshots import take_snapshot
from app.study.repository import participant_by_code
from app.tables.recordings import Recording
from tests.app.ingest.conftest import device_zip, loose
from tests.conftest import PASSWORD

STATED = {"visit": 1, "controller": "random"}
FOLDER = device_zip()


def only(*stems: str) -> list[tuple[str, bytes]]:
    """Select loose files of the folder."""
    return [f for f in loose(FOLDER) if any(f[0].startswith(stem) for stem in stems)]


def with_member(name: str, content: bytes) -> bytes:
    """Add one more file to the folder."""
    sink = io.BytesIO(FOLDER)
    with zipfile.ZipFile(sink, "a") as archive:
        folder = archive.namelist()[-1].rsplit("/", 1)[0]
        archive.writestr(f"{folder}/{name}", content)
    return sink.getvalue()


def changed(change: Callable[[str, bytes], bytes], folder: bytes = FOLDER) -> bytes:
    """Change every file of a folder."""
    sink = io.BytesIO()
    with zipfile.ZipFile(io.BytesIO(folder)) as old, zipfile.ZipFile(sink, "w") as new:
        for name in old.namelist():
            new.writestr(name, change(name, old.read(name)))
    return sink.getvalue()


def cut(name: str, content: bytes) -> bytes:
    """Cut the streams to the first half of their packets."""
    return _packets(name, content, lambda n: slice(n // 2))


def cut_off(name: str, content: bytes) -> bytes:
    """Cut the streams to the second half of their packets."""
    return _packets(name, content, lambda n: slice(n // 2, None))


def _packets(name: str, content: bytes, kept: Callable[[int], slice]) -> bytes:
    if "RawData" not in name:
        return content
    body = json.loads(content)
    for key in ("TimeDomainData", "PowerDomainData"):
        if body[0].get(key):
            body[0][key] = body[0][key][kept(len(body[0][key]))]
    return json.dumps(body).encode()


def other_signal(name: str, content: bytes) -> bytes:
    """Replace the samples of the packets."""
    if "RawDataTD" not in name:
        return content
    body, rng = json.loads(content), np.random.default_rng(1)
    for packet in body[0]["TimeDomainData"]:
        for channel in packet["ChannelSamples"]:
            channel["Value"] = [float(v) for v in 0.01 * rng.standard_normal(len(channel["Value"]))]
    return json.dumps(body).encode()


@pytest.fixture
def buffer_steps(client: TestClient, db: Session) -> Callable[[], int]:
    """Steps of a snapshot of what is confirmed now."""

    def take() -> int:
        settings = {"beta_unit": "uV", "beta_source": "time_domain", "cdbs_amplitude_ma": 4.0, "most_imputed": 0}
        client.put("/api/v1/participants/P1/settings", json={"settings": settings})
        db.rollback()
        snapshot = take_snapshot(db, participant_by_code(db, "P1", SYSTEM), SYSTEM)
        db.commit()
        return snapshot.steps

    return take


def sessions_of(client: TestClient) -> list[dict[str, Any]]:
    visit = client.get("/api/v1/participants/P1/visits").json()["items"][0]["id"]
    return list(client.get(f"/api/v1/visits/{visit}/sessions").json()["items"])


def test_loose_files_first_and_the_folder_later_are_one_session(
    send: Any, client: TestClient, db: Session, buffer_steps: Callable[[], int]
) -> None:
    first = send(*only("RawDataTD", "DeviceSettings"), **STATED).json()
    assert [s["status"] for s in first["sessions"]] == ["confirmed"]
    later = send(("folder.zip", FOLDER), **STATED).json()
    (session,) = sessions_of(client)
    assert session["id"] == first["sessions"][0]["id"] == later["sessions"][0]["id"]
    assert later["proposals"] == []
    assert "A fuller copy of the minutes of recording" in str(later["report"])
    alone = buffer_steps()
    assert alone > 10
    old, new = db.scalars(select(Recording).order_by(Recording.id)).all()
    assert (old.superseded_by_id, session["recordings"]) == (new.id, [new.id])
    again = send(*only("RawDataTD", "DeviceSettings"), **STATED).json()
    assert [s["id"] for s in again["sessions"]] == [session["id"]]
    assert buffer_steps() == alone, "34 steps where 17 were measured"


def test_an_empty_file_more_another_zip_and_a_truncated_copy_are_no_new_session(send: Any, client: TestClient, db: Session) -> None:
    first = send(("a.zip", FOLDER), **STATED).json()["sessions"][0]["id"]
    for content in (with_member("EventLogs.json", b""), with_member("notes.txt", b"-"), changed(cut)):
        answer = send(("b.zip", content), **STATED)
        assert [s["id"] for s in answer.json()["sessions"]] == [first], answer.text
    assert len(db.scalars(select(Recording)).all()) == 1
    assert len(sessions_of(client)) == 1


def test_a_truncated_copy_of_a_lossy_recording_counts_once_and_another_signal_does_not(
    send: Any, client: TestClient, recordings: Path
) -> None:
    lossy = (recordings / "rcs" / "montage_packet_loss.zip").read_bytes()
    first = send(("m.zip", lossy), visit=1, controller="other").json()["sessions"][0]["id"]
    truncated = send(("half.zip", changed(cut, lossy)), visit=1, controller="other")
    assert [s["id"] for s in truncated.json()["sessions"]] == [first], "gaps are predicted from all that a copy has, and it has half"
    answer = send(("other.zip", changed(other_signal, lossy)), visit=1, controller="other").json()
    (second,) = [s for s in answer["sessions"] if s["id"] != first]
    assert second["status"] == "proposed"
    refused = client.post(f"/api/v1/proposals/{second['id']}/confirm", json={"version": 1, "controller": "other"})
    assert (refused.status_code, refused.json()["sessions"]) == (409, [second["id"], first])


def test_a_truncated_copy_first_gives_way_to_the_whole_recording(send: Any, client: TestClient) -> None:
    first = send(("half.zip", changed(cut)), visit=1).json()["proposals"][0]
    half = client.get(f"/api/v1/proposals/{first['session']['id']}").json()["session"]["duration_s"]
    whole = send(("whole.zip", FOLDER), visit=1).json()
    assert [s["id"] for s in whole["sessions"]] == [first["session"]["id"]]
    now = client.get(f"/api/v1/proposals/{first['session']['id']}").json()
    assert now["session"]["duration_s"] > 1.8 * half
    assert now["version"] > first["version"]


def test_minutes_that_differ_are_both_shown_and_only_one_can_be_confirmed(
    send: Any, client: TestClient, buffer_steps: Callable[[], int]
) -> None:
    first = send(("a.zip", FOLDER), **STATED).json()["sessions"][0]["id"]
    answer = send(("b.zip", changed(other_signal)), **STATED).json()
    (second,) = [s for s in answer["sessions"] if s["id"] != first]
    assert second["status"] == "proposed", "what counts already is not doubled without a person's word"
    assert f"stand in session {first} (recording" in str(answer["report"])
    page = client.get(f"/proposals/{second['id']}", headers={"Accept": "text/html"}).text
    assert f"session {first} (recording" in page
    body = {"version": 1, "controller": "random"}
    refused = client.post(f"/api/v1/proposals/{second['id']}/confirm", json=body)
    assert refused.status_code == 409
    assert refused.json()["sessions"] == [second["id"], first]
    steps = buffer_steps()
    client.patch(f"/api/v1/sessions/{first}", json={"excluded_reason": "the other copy is the right one"})
    confirmed = client.post(f"/api/v1/proposals/{second['id']}/confirm", json=body)
    assert confirmed.status_code == 200, confirmed.text
    assert buffer_steps() == steps
    back = client.patch(f"/api/v1/sessions/{first}", json={"excluded_reason": None})
    assert (back.status_code, "the same minutes count once" in back.text) == (409, True)


def test_the_database_lets_no_minute_of_a_device_and_side_count_twice(send: Any, client: TestClient, db: Session) -> None:
    first = send(("a.zip", FOLDER), **STATED).json()["sessions"][0]["id"]
    second = send(("b.zip", changed(other_signal)), **STATED).json()["proposals"][0]["session"]["id"]
    confirm = text("update session set controller = 'random', status = 'confirmed' where id = :id")
    with pytest.raises(IntegrityError, match="counted_time_once"):
        db.execute(confirm, {"id": second})
    db.rollback()
    db.execute(text("update recording set hemisphere = 'left' where id = (select max(id) from recording)"))
    db.execute(confirm, {"id": second})
    assert db.scalar(text("select count(*) from counted_time")) == 2, "the other side of the same device is another signal"
    with pytest.raises(IntegrityError, match="counted_time_once"):
        db.execute(text("update recording set hemisphere = null where id = (select max(id) from recording)"))
    db.rollback()
    db.execute(text("update recording set started_at = started_at + interval '1 day' where id = (select max(id) from recording)"))
    db.execute(confirm, {"id": second})
    db.execute(text("delete from session_segment where session_id = :id"), {"id": first})
    assert db.scalar(text("select array_agg(session_id) from counted_time")) == [second]


def test_a_recording_of_the_next_minutes_is_another_session(send: Any, client: TestClient) -> None:
    send(("a.zip", FOLDER), **STATED)
    answer = send(("b.zip", device_zip(minute=5.0, seed=9)), **STATED)
    assert answer.status_code == 201
    assert len(sessions_of(client)) == 2


def test_minutes_that_count_twice_since_before_are_left_out_of_buffers_by_name(
    send: Any, client: TestClient, owner_db: Session, buffer_steps: Callable[[], int]
) -> None:
    first = send(("a.zip", FOLDER), **STATED).json()["sessions"][0]["id"]
    steps = buffer_steps()
    second = send(("b.zip", changed(other_signal)), **STATED).json()["proposals"][0]["session"]["id"]
    owner_db.execute(text("alter table session disable trigger count_time"))
    owner_db.execute(text("update session set controller = 'random', status = 'confirmed' where id = :id"), {"id": second})
    owner_db.execute(text("alter table session enable trigger count_time"))
    owner_db.commit()
    assert buffer_steps() == steps
    client.patch(f"/api/v1/sessions/{first}", json={"excluded_reason": "no"})
    assert buffer_steps() > 0, "the first one is excluded, so that the minutes count by the second"


def rows(values: list[float], at: float = 0.0, error: list[float] | None = None) -> Rows:
    x = np.array(values)
    return Rows(at + 2.0 * np.arange(1, x.size + 1), x, 2.0, "uV", None if error is None else np.array(error))


def test_what_two_recordings_of_the_same_minutes_are_to_each_other() -> None:
    rng = np.random.default_rng(4)
    fine = np.convolve(rng.standard_normal(4000), np.ones(20) / 20, "same") + 3
    signal = [float(fine[40 * i : 40 * i + 40].mean()) for i in range(90)]
    late = [float(fine[40 * i + 20 : 40 * i + 60].mean()) for i in range(90)]
    beta, power, amplitude = ("beta", "a"), ("band_power", "b"), ("amplitude", "")
    old = {beta: rows(signal), amplitude: rows([1.0] * 90)}
    assert relation({beta: rows(signal[:40])}, old) is Relation.NO_MORE
    assert relation(old, old) is Relation.NO_MORE
    assert relation({**old, power: rows(signal)}, old) is Relation.FULLER
    assert relation({**old, beta: rows(late, at=1.0)}, old) is Relation.NO_MORE, "the same signal on a grid that is half a row off"
    assert relation({**old, beta: rows(list(rng.standard_normal(90)), at=1.0)}, old) is Relation.DIFFERS
    assert relation({**old, beta: rows([v + 0.5 for v in signal])}, old) is Relation.DIFFERS
    assert relation({beta: rows(signal), power: rows(signal)}, old) is Relation.EACH_ITS_OWN
    assert relation({power: rows(signal)}, {beta: rows(signal)}) is Relation.EACH_ITS_OWN
    assert relation({beta: rows(signal), amplitude: rows([2.0] * 90)}, {amplitude: rows([1.0] * 90)}) is Relation.FULLER
    holed = [*signal[:80], *[float("nan")] * 10]
    assert relation({beta: rows(holed), amplitude: rows([1.0] * 90)}, old) is Relation.NO_MORE
    assert relation(old, {beta: rows(holed)}) is Relation.FULLER


def test_rows_with_predicted_samples_are_equal_to_within_a_part_of_their_errors() -> None:
    rng = np.random.default_rng(5)
    beta, signal = ("beta", "a"), 1 + 0.15 * rng.standard_normal(60)
    gaps = np.full(60, 0.04)
    near, other = signal + 0.003 * rng.standard_normal(60), 1 + 0.15 * rng.standard_normal(60)

    def held(values: np.ndarray, error: np.ndarray) -> Relation:
        return relation({beta: rows(list(values), error=list(error))}, {beta: rows(list(signal), error=list(error))})

    assert held(near, gaps) is Relation.NO_MORE
    assert held(near, np.zeros(60)) is Relation.DIFFERS, "nothing was predicted, so that nothing may differ"
    assert held(other, gaps) is Relation.DIFFERS
    partly = np.where(np.arange(60) < 12, 0.0, 0.04)
    assert held(np.where(partly == 0, signal, near + 0.1), partly) is Relation.NO_MORE, "12 whole rows are enough, and equal"
    assert held(np.where(partly == 0, other, signal), partly) is Relation.DIFFERS
    assert held(other, np.full(60, 0.5)) is Relation.EACH_ITS_OWN, "errors as large as the signal's changes tell nothing"


def test_a_recording_that_goes_on_after_a_stored_one_ended_is_no_copy_of_it() -> None:
    signal = [float(v) for v in 3 + np.random.default_rng(2).standard_normal(120)]
    beta = ("beta", "a")
    early, late = {beta: rows(signal[:80])}, {beta: rows(signal[40:], at=80.0)}
    assert relation(late, early) is Relation.EACH_ITS_OWN, "as many rows, and half of them are of minutes that nobody else has"
    assert relation(early, late) is Relation.EACH_ITS_OWN
    assert relation({beta: rows(signal)}, late) is Relation.FULLER


def test_two_parts_keep_their_minutes_in_the_whole_recording(send: Any, client: TestClient) -> None:
    for name, part in (("first.zip", cut), ("second.zip", cut_off)):
        assert send((name, changed(part)), **STATED).status_code == 201
    before = sessions_of(client)
    assert len(before) == 2
    whole = send(("whole.zip", FOLDER), **STATED).json()
    assert "the decoder failed" not in str(whole["report"])
    after = sessions_of(client)
    assert [s["id"] for s in after] == [s["id"] for s in before]
    assert [s["duration_s"] for s in after] == pytest.approx([s["duration_s"] for s in before], abs=3)
    assert len({r for s in after for r in s["recordings"]}) == 1


def test_a_fuller_copy_changes_no_session_of_a_locked_visit(send: Any, client: TestClient) -> None:
    send(("half.zip", changed(cut)), **STATED)
    (before,) = sessions_of(client)
    assert (
        client.post(f"/api/v1/visits/{before['visit_id']}/lock", json={"reason": "data complete", "password": PASSWORD}).status_code == 200
    )
    answer = send(("whole.zip", FOLDER)).json()
    assert sessions_of(client)[0] == before
    assert [p["session"]["id"] for p in answer["proposals"]] != [before["id"]]
    assert f"session {before['id']} of a locked visit is made: nothing was changed there" in str(answer["report"])
