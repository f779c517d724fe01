"""Sessions of signed plans on a simulated device: they run on their day, once, and whatever breaks leaves a whole record."""

from __future__ import annotations

import dataclasses
import json
from collections.abc import Iterable
from datetime import datetime, timedelta
from pathlib import Path
from zoneinfo import ZoneInfo

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey

from app.platform.errors import Invalid
from app.tablet.command import control, verified
from app.tablet.live import run_live
from app.tablet.simulated import Sent, SimulatedDevice, brain_of
from app.tablet.sources import Task, Wish
from ml.deploy.runtime.control_loop import End
from ml.deploy.runtime.inputs import Event
from ml.deploy.runtime.ledger import Attempt, Ledger
from ml.deploy.runtime.session import Outcome, Tablet, run_slot
from ml.deploy.runtime.signature import verifies
from ml.deploy.runtime.slot import NotAllowed, Refusal, Slot, Withdrawals, withdrawals_body
from ml.formats import decode
from tests.app.tablet.control_bundles import HOLDS, KEY, MORNING, PUBLIC, SLOT, made, of_slot, rows_of, scheduled


def run(bundle: Path, folder: Path, now: datetime = MORNING, log: str = "log.csv", **task: object) -> Outcome:
    """Run a whole session on the simulated device, in the time that its computations take."""
    stated = Task(log=folder / log, key=PUBLIC, ledger=folder / "ledger", **task)  # type: ignore[arg-type]
    return run_live(verified(bundle, PUBLIC), bundle.name, "simulated:P1:3", stated, now=lambda: now)[0]


def test_a_whole_session_runs_in_closed_loop_and_its_log_says_whose_it_is(tmp_path: Path) -> None:
    outcome = run(of_slot(tmp_path), tmp_path)
    assert outcome.end is End.COMPLETE
    rows = rows_of(tmp_path / "log.csv")
    assert [row["action"] for row in rows] == ["cdbs"] * 9 + ["policy"] * 150 + ["cdbs"]
    assert rows[-1]["ended"] == "complete"
    device = outcome.session.link
    assert isinstance(device, SimulatedDevice)
    assert len(set(np.round(device.amplitudes_ma, 3))) > 5, "the loop is closed"
    (recording,) = decode(tmp_path / "log.csv").recordings
    beta, amplitude = (next(t for t in recording.traces if t.stream == stream) for stream in ("beta", "amplitude"))
    assert beta.t_end_s[0] == -18.0
    assert beta.t_end_s[-1] == 300.0
    np.testing.assert_allclose(amplitude.values[1:], device.amplitudes_ma[1:160], rtol=1e-4)
    said = recording.settings["controller"]
    assert (said["slot_id"], said["plan_id"], said["controller"], said["ended"], said["purpose"]) == (7, 1, "rl", "complete", "session")
    assert said["manifest_sha256"] == verified(of_slot(tmp_path), PUBLIC).manifest_sha256
    assert said["policy_share"] == 1.0, "from the take-over on"
    assert said["latency_us"]["n"] == 200
    assert recording.started_at == MORNING + timedelta(seconds=20)


@pytest.mark.hazard("H17")
def test_a_simulated_session_runs_on_the_simulations_clock_and_neither_uses_up_the_slot_nor_hides_what_it_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("app.tablet.live.LEDGER", tmp_path / "ledger")
    bundle, log = of_slot(tmp_path), tmp_path / "log.csv"
    opened, later = verified(bundle, PUBLIC), MORNING + timedelta(hours=3)
    outcome, _ = run_live(opened, bundle.name, "simulated:P1:3", Task(log=log, begins=later), now=lambda: MORNING)
    assert outcome.end is End.COMPLETE
    (recording,) = decode(log).recordings
    assert recording.settings["controller"]["simulated"] is True
    assert recording.started_at == later + timedelta(seconds=20)
    real = Ledger(tmp_path / "ledger")
    real.check_unused("P1", SLOT)  # raises where the slot was used up
    real.check_clock(MORNING)  # and where the clock has gone on to the simulation's
    midnight = Task(log=tmp_path / "late.csv", begins=MORNING.replace(hour=23, minute=58), ledger=tmp_path / "other")
    late, _ = run_live(opened, bundle.name, "simulated:P1:3", midnight, now=lambda: MORNING)
    assert late.end is End.EXPIRED, "the simulated day ends, and the session with it"
    with pytest.raises(Invalid, match="begins when it begins"):
        run_live(opened, bundle.name, "tcp:0", Task(log=tmp_path / "no.csv", begins=later))


@pytest.mark.hazard("H23")
def test_a_random_session_runs_its_signed_schedule_and_the_log_has_holds_and_densities(tmp_path: Path) -> None:
    bundle = scheduled(tmp_path)
    assert verified(bundle, PUBLIC).manifest.schedule is not None
    outcome = run(bundle, tmp_path)
    assert outcome.end is End.COMPLETE
    (recording,) = decode(tmp_path / "log.csv").recordings
    said = recording.settings["controller"]
    assert (said["design"], said["level"], said["seed"], said["lower_bound"]) == ("stratified", 0.71, 12, 0.3)
    assert said["holds"] == [dataclasses.asdict(hold) for hold in HOLDS]
    amplitude = next(t for t in recording.traces if t.stream == "amplitude")
    delivered = amplitude.values[amplitude.t_end_s > 0] / 3.0
    np.testing.assert_allclose(delivered, np.repeat([h.amplitude for h in HOLDS], [h.steps for h in HOLDS]), atol=2e-3)


@pytest.mark.hazard("H23")
def test_a_lost_link_interrupts_a_random_session_and_what_was_not_drawn_has_no_density(tmp_path: Path) -> None:
    def lose(number: int, line: str) -> Iterable[Sent]:
        return [] if number in (39, 40) else [(0.0, Event.LINE, line)]

    opened = verified(scheduled(tmp_path), PUBLIC)
    device = SimulatedDevice(brain_of("P1:3", opened.manifest, 400), opened.manifest, lose)
    tablet = Tablet(ledger=Ledger(tmp_path / "ledger"), now=lambda: MORNING)
    run_slot(opened.manifest_json, opened.manifest_sha256, opened.controller(), device, tmp_path / "log.csv", tablet)
    (recording,) = decode(tmp_path / "log.csv").recordings
    holds = recording.settings["controller"]["holds"]
    assert [(h["start"], h["log_density"]) for h in holds] == [(0, -0.3), (20, 0.4), (30, None), (41, 0.4), (50, 0.2), (90, -1.1)]
    assert holds[2]["amplitude"] == 1.0
    assert sum(h["steps"] for h in holds) == 150


@pytest.mark.hazard("H17")
def test_a_slot_runs_once_whatever_bundle_of_it_is_taken(tmp_path: Path) -> None:
    run(of_slot(tmp_path), tmp_path)
    again = of_slot(tmp_path, taken_by="somebody, a minute later")
    with pytest.raises(Invalid, match=r"began at 2026-03-02T09:30:00\+00:00 and ended .* \(complete\); a slot runs once"):
        run(again, tmp_path, log="again.csv")
    assert not (tmp_path / "again.csv").exists()
    other = of_slot(tmp_path, slot=dataclasses.replace(SLOT, slot_id=9, position=4, repeat=2))
    assert run(other, tmp_path, log="repeat.csv").end is End.COMPLETE


@pytest.mark.hazard("H17")
def test_of_two_that_start_one_slot_at_the_same_time_one_runs(tmp_path: Path) -> None:
    ledger = Ledger(tmp_path)
    ledger.check_unused("P1", SLOT)
    first = ledger.begin("P1", SLOT, MORNING, tmp_path / "log.csv", "a" * 64)
    with pytest.raises(NotAllowed) as refused:
        ledger.begin("P1", SLOT, MORNING, tmp_path / "other.csv", "b" * 64)
    assert refused.value.code is Refusal.RUNNING
    first.decide(MORNING)
    first.file.close()  # as a process that is killed
    with pytest.raises(NotAllowed) as refused:
        ledger.begin("P1", SLOT, MORNING, tmp_path / "other.csv", "b" * 64)
    assert refused.value.code is Refusal.BROKEN_OFF


@pytest.mark.hazard("H17")
@pytest.mark.parametrize(
    ("text", "used"),
    [
        ('{"began": "x", "attempt": 1, "log": "l"}\n', False),
        ('{"began": "x", "attempt": 1, "log": "l"}\n{"decid', False),
        ('{"began": "x", "attempt": 1, "log": "l"}\n{"decided": "y"}\n', True),
        ('{"began": "x", "attempt": 1, "log": "l"}\nnoise\n', True),
        ('{"began": "x", "log": "l"}\n{"ended": "y", "how": "complete", "decisions": 9}\n', True),
        ('{"beg', False),
    ],
)
def test_a_killed_attempt_uses_the_slot_where_its_policy_had_decided(tmp_path: Path, text: str, used: bool) -> None:
    ledger = Ledger(tmp_path)
    (tmp_path / "P1-plan-1-slot-7.run").write_text(text)
    if used:
        with pytest.raises(NotAllowed):
            ledger.begin("P1", SLOT, MORNING, tmp_path / "log.csv", "a" * 64)
        return
    attempt = ledger.begin("P1", SLOT, MORNING, tmp_path / "log.csv", "a" * 64)
    attempt.decide(MORNING)
    attempt.end(MORNING, "complete", 3)
    with pytest.raises(NotAllowed, match=r"ended at .* \(complete\)"):
        ledger.check_unused("P1", SLOT)


@pytest.mark.hazard("H02", "H17")
def test_a_refused_hello_leaves_the_slot_free_and_the_next_attempt_is_numbered(tmp_path: Path) -> None:
    opened = verified(of_slot(tmp_path), PUBLIC)
    stranger = SimulatedDevice(brain_of("P1:3", opened.manifest, 400), dataclasses.replace(opened.manifest, participant="P2"))
    tablet = Tablet(ledger=Ledger(tmp_path / "ledger"), now=lambda: MORNING)
    first = run_slot(opened.manifest_json, opened.manifest_sha256, opened.controller(), stranger, tmp_path / "first.csv", tablet)
    assert first.end is End.STRANGER
    device = SimulatedDevice(brain_of("P1:3", opened.manifest, 400), opened.manifest)
    second = run_slot(opened.manifest_json, opened.manifest_sha256, opened.controller(), device, tmp_path / "second.csv", tablet)
    assert second.end is End.COMPLETE
    lines = [json.loads(line) for line in next((tmp_path / "ledger").glob("*.run")).read_text().splitlines()]
    assert [next(iter(line)) for line in lines] == ["began", "ended", "began", "decided", "ended"]
    assert [line.get("attempt") for line in lines if "began" in line] == [1, 2]
    assert '"attempt": 2' in (tmp_path / "second.csv").read_text()
    with pytest.raises(NotAllowed, match="a slot runs once"):
        run_slot(opened.manifest_json, opened.manifest_sha256, opened.controller(), device, tmp_path / "third.csv", tablet)


@pytest.mark.hazard("H16", "H17")
def test_no_amplitude_of_a_policy_leaves_before_the_slot_is_noted_as_used(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(_attempt: Attempt, _now: datetime) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(Attempt, "decide", full)
    opened = verified(of_slot(tmp_path), PUBLIC)
    device = SimulatedDevice(brain_of("P1:3", opened.manifest, 400), opened.manifest)
    tablet = Tablet(ledger=Ledger(tmp_path / "ledger"), now=lambda: MORNING)
    outcome = run_slot(opened.manifest_json, opened.manifest_sha256, opened.controller(), device, tmp_path / "log.csv", tablet)
    assert outcome.end is End.LOG_FAILED
    assert "cannot be noted: No space left" in outcome.detail
    assert set(device.amplitudes_ma) == {3.0}


@pytest.mark.hazard("H18")
@pytest.mark.parametrize(
    ("now", "words"),
    [
        ("2026-03-01T23:59:00+00:00", "the bundle was made at 2026-03-02 08:00: set the clock"),
        ("2026-03-03T00:00:10+00:00", "expired that night"),
        ("2026-04-02T09:00:00+00:00", "expired that night"),
        ("2026-03-02T07:00:00+00:00", "set the clock"),
    ],
)
def test_a_bundle_runs_on_the_day_of_its_visit_alone(tmp_path: Path, now: str, words: str) -> None:
    with pytest.raises(Invalid, match=words):
        run(of_slot(tmp_path), tmp_path, datetime.fromisoformat(now))
    assert not (tmp_path / "log.csv").exists()


@pytest.mark.hazard("H18")
def test_a_bundle_of_tomorrow_waits_and_a_clock_that_is_set_back_opens_nothing(tmp_path: Path) -> None:
    tomorrow = dataclasses.replace(SLOT, visit_date="2026-03-03", slot_id=20)
    with pytest.raises(Invalid, match=r"for the visit of 2026-03-03; today is 2026-03-02"):
        run(of_slot(tmp_path, slot=tomorrow), tmp_path)
    run(of_slot(tmp_path, slot=tomorrow), tmp_path, MORNING + timedelta(days=1))
    with pytest.raises(Invalid, match="showed 2026-03-03 09:30 before"):
        run(of_slot(tmp_path), tmp_path, MORNING, log="back.csv")


@pytest.mark.hazard("H18")
def test_a_clock_that_was_an_hour_fast_may_be_set_right_within_the_day(tmp_path: Path) -> None:
    run(of_slot(tmp_path), tmp_path, MORNING + timedelta(hours=1))
    second = of_slot(tmp_path, slot=dataclasses.replace(SLOT, slot_id=21, position=3))
    assert run(second, tmp_path, MORNING + timedelta(minutes=15), log="second.csv").end is End.COMPLETE
    with pytest.raises(Invalid, match="a slot runs once"):
        run(of_slot(tmp_path), tmp_path, MORNING + timedelta(minutes=30), log="again.csv")


@pytest.mark.hazard("H12")
@pytest.mark.parametrize("start", ["2026-10-25T00:58:00+00:00", "2026-03-29T00:58:00+00:00"])
def test_summer_time_that_ends_or_begins_in_mid_session_changes_neither_periods_nor_times(tmp_path: Path, start: str) -> None:
    began, place = datetime.fromisoformat(start), ZoneInfo("Europe/Berlin")
    slot = dataclasses.replace(SLOT, visit_date=start[:10], issued_at=f"{start[:10]}T00:10:00+00:00")
    opened = verified(of_slot(tmp_path, slot=slot), PUBLIC)
    device = SimulatedDevice(brain_of("P1:3", opened.manifest, 400), opened.manifest)
    ledger = Ledger(tmp_path / "ledger")
    tablet = Tablet(ledger=ledger, now=lambda: (began + timedelta(seconds=device.now())).astimezone(place))
    log = tmp_path / "log.csv"
    outcome = run_slot(opened.manifest_json, opened.manifest_sha256, opened.controller(), device, log, tablet)
    assert outcome.end is End.COMPLETE
    assert tablet.now().utcoffset() != began.astimezone(place).utcoffset(), "the hour changed on the way"
    np.testing.assert_allclose(np.diff([d.t_s for d in outcome.session.decisions]), 2.0, atol=0.5)
    (recording,) = decode(log).recordings
    assert recording.started_at == began + timedelta(seconds=20)
    ledger.check_clock(tablet.now())  # raises where the hour that came twice is taken for a clock that was set back


@pytest.mark.hazard("H15")
@pytest.mark.hazard("H18")
def test_a_session_that_reaches_midnight_ends_there(tmp_path: Path) -> None:
    opened = verified(of_slot(tmp_path), PUBLIC)
    device = SimulatedDevice(brain_of("P1:3", opened.manifest, 400), opened.manifest)
    late = datetime.fromisoformat("2026-03-02T23:58:00+00:00")
    tablet = Tablet(ledger=Ledger(tmp_path / "ledger"), now=lambda: late + timedelta(seconds=device.now()))
    outcome = run_slot(opened.manifest_json, opened.manifest_sha256, opened.controller(), device, tmp_path / "log.csv", tablet)
    assert outcome.end is End.EXPIRED
    assert outcome.session.decisions[-1].t_s == pytest.approx(120.0, abs=2.1)
    assert device.device.look(device.now()) == 3.0


def withdrawals(folder: Path, key: Ed25519PrivateKey = KEY, issued: str = "2026-03-02T08:30:00+00:00", **named: frozenset[int]) -> Path:
    body = withdrawals_body(Withdrawals(issued, named.get("policies", frozenset()), named.get("plans", frozenset())))
    path = folder / "withdrawn.json"
    path.write_bytes(body + b"\n" + key.sign(body).hex().encode() + b"\n")
    return path


@pytest.mark.hazard("H20")
def test_a_withdrawn_policy_is_refused_and_stays_so_without_the_list(tmp_path: Path) -> None:
    with pytest.raises(Invalid, match="policy 3 was withdrawn"):
        run(of_slot(tmp_path), tmp_path, withdrawn=withdrawals(tmp_path, policies=frozenset({3, 9})))
    with pytest.raises(Invalid, match="policy 3 was withdrawn"):
        run(of_slot(tmp_path), tmp_path)
    older = withdrawals(tmp_path, issued="2026-03-01T08:30:00+00:00")
    with pytest.raises(Invalid, match="older than the one that is known"):
        run(of_slot(tmp_path), tmp_path, withdrawn=older)
    forged = withdrawals(tmp_path, Ed25519PrivateKey.from_private_bytes(b"x" * 32), issued="2026-03-02T09:00:00+00:00")
    with pytest.raises(Invalid, match="signature does not belong to the study's key"):
        run(of_slot(tmp_path), tmp_path, withdrawn=forged)


@pytest.mark.hazard("H18")
def test_a_plan_that_was_replaced_is_refused(tmp_path: Path) -> None:
    with pytest.raises(Invalid, match="plan 1 was replaced or withdrawn"):
        run(of_slot(tmp_path), tmp_path, withdrawn=withdrawals(tmp_path, plans=frozenset({1})))


@pytest.mark.hazard("H19")
def test_what_nobody_signed_runs_on_the_bench_alone(tmp_path: Path) -> None:
    with pytest.raises(Invalid, match=r"for no session of a signed plan .* runs on the bench alone"):
        run(made(tmp_path), tmp_path)
    with pytest.raises(Invalid, match="the plan of this bundle is not signed"):
        run(made(tmp_path, slot=SLOT), tmp_path)
    assert not (tmp_path / "ledger").exists()
    bench = run(made(tmp_path), tmp_path, bench=True)
    assert bench.end is End.COMPLETE
    assert decode(tmp_path / "log.csv").recordings[0].settings["controller"]["purpose"] == "bench"


@pytest.mark.hazard("H01")
def test_another_participants_bundle_is_refused_by_the_code_on_the_chart_and_by_the_device(tmp_path: Path) -> None:
    bundle = of_slot(tmp_path)
    with pytest.raises(Invalid, match="of participant P1, not P2"):
        control(bundle, "simulated:P1:3", Wish(), Task(log=tmp_path / "log.csv", key=PUBLIC, participant="P2", ledger=tmp_path / "l"))
    opened = verified(bundle, PUBLIC)
    stranger = SimulatedDevice(brain_of("P1:3", opened.manifest, 400), dataclasses.replace(opened.manifest, participant="P2"))
    tablet = Tablet(ledger=Ledger(tmp_path / "ledger"), now=lambda: MORNING)
    outcome = run_slot(opened.manifest_json, opened.manifest_sha256, opened.controller(), stranger, tmp_path / "log.csv", tablet)
    assert (outcome.end, outcome.detail) == (End.STRANGER, "participant P2 instead of P1")
    assert set(stranger.amplitudes_ma) <= {3.0}


def test_signatures_are_checked_in_plain_python_as_by_the_library() -> None:
    rng = np.random.default_rng(4)
    for _ in range(12):
        key = Ed25519PrivateKey.from_private_bytes(rng.bytes(32))
        public, message = key.public_key().public_bytes_raw(), rng.bytes(int(rng.integers(0, 300)))
        signature = key.sign(message)
        assert verifies(public, message, signature)
        for place in (0, 31, 32, 63):
            spoilt = signature[:place] + bytes([signature[place] ^ (1 << int(rng.integers(8)))]) + signature[place + 1 :]
            assert not verifies(public, message, spoilt)
        assert not verifies(public, message + b".", signature)
        assert not verifies(Ed25519PrivateKey.from_private_bytes(rng.bytes(32)).public_key().public_bytes_raw(), message, signature)
    assert not verifies(b"\xff" * 32, b"", b"\xff" * 64)
    assert not verifies(b"", b"", b"")


def test_slots_without_a_real_day_or_minutes_are_refused() -> None:
    for change in ({"visit_date": "soon"}, {"minutes": 0}, {"issued_at": "2026-03-02T08:00:00"}):
        with pytest.raises(ValueError, match=r"soon|minutes|offset"):
            Slot(**dataclasses.asdict(SLOT) | change)
