"""`betaloop control` when something is wrong: whose bundle, the log, the stream, the clock, the battery's assumptions."""

from __future__ import annotations

import io
import json
import signal
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from typer.testing import CliRunner

from app.cli import app as command_line
from app.platform.errors import Invalid
from app.tablet.command import Run, control, drive, lines, verified
from app.tablet.sources import Row, Source, Task, Wish, open_source
from ml.deploy.runtime.envelope import BetaSample, Reason, Signal
from tests.app.tablet.control_bundles import APPROVAL, MANIFEST, PUBLIC, made, rows_of


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    return made(tmp_path)


def betaloop(*arguments: str, **options: Any) -> subprocess.Popen[str]:
    """Start the command as a process of its own."""
    call = [sys.executable, "-c", "from app.cli import main; main()", *arguments]
    return subprocess.Popen(call, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, **options)


@pytest.mark.hazard("H01")
def test_a_bundle_is_run_for_its_participant_alone(bundle: Path) -> None:
    with pytest.raises(Invalid, match="of participant P1, not P2"):
        control(bundle, "cohort:P2", Wish(steps=5), Task(key=PUBLIC, participant="P2"))
    summary = control(bundle, "cohort:P1", Wish(steps=5), Task(key=PUBLIC, participant="P1"))
    assert (summary["decisions"], summary["policy_name"]) == (15, "rl-01")
    assert not any("synthetic participant" in text for text in summary["warnings"])
    other = control(bundle, "cohort:P2", Wish(steps=5), Task(key=PUBLIC))
    assert "The bundle is of participant P1, the source is synthetic participant P2." in lines(other)


def test_a_source_of_another_signal_throughout_is_said_and_has_an_exit_code(bundle: Path, tmp_path: Path) -> None:
    table = tmp_path / "steps.csv"
    table.write_text("t_s,beta [mV],amplitude_fraction\n" + "".join(f"{2 * (k + 1)},1.5,1\n" for k in range(15)))
    call = ["control", "--bundle", str(bundle), "--key", PUBLIC, "--source", str(table), "--speed", "fast"]
    wrong = CliRunner().invoke(command_line, call)
    assert wrong.exit_code == 1
    assert "NO DECISION BY THE POLICY: the bundle takes beta in uV from time_domain; the source gives" in wrong.output
    right = CliRunner().invoke(
        command_line, ["control", "--bundle", str(bundle), "--key", PUBLIC, "--source", "cohort:P1", "--speed", "fast"]
    )
    assert right.exit_code == 0
    assert "NO DECISION" not in right.output


@pytest.mark.hazard("H19")
def test_a_bundle_of_no_signed_slot_does_not_run_live_unless_nobody_is_connected(
    bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO("1.5\n"))
    live, task = Wish(realtime=True), Task(key=PUBLIC, log=tmp_path / "log.csv", ledger=tmp_path / "ledger")
    with pytest.raises(Invalid, match="must not be run: this bundle is for no session of a signed plan"):
        control(bundle, "-", live, task)
    (tmp_path / "a").mkdir()
    with pytest.raises(Invalid, match="must not be run: this bundle is for no session of a signed plan"):
        control(made(tmp_path / "a", approvals=(APPROVAL,)), "-", live, task)
    with pytest.raises(Invalid, match="needs a log"):
        control(bundle, "-", live, Task(key=PUBLIC))
    summary = control(bundle, "-", live, Task(key=PUBLIC, bench=True))
    assert summary["ended"].startswith("input_ended")
    assert "NOT APPROVED" in lines(summary)


def test_a_log_is_not_written_over(bundle: Path, tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    control(bundle, "cohort:P1", Wish(steps=5), Task(log=log, key=PUBLIC))
    before = log.read_bytes()
    with pytest.raises(Invalid, match="there already"):
        control(bundle, "cohort:P1", Wish(steps=5), Task(log=log, key=PUBLIC))
    assert log.read_bytes() == before


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="needs a device that is always full")
def test_a_full_disk_ends_the_run_with_what_where_and_an_exit_code(bundle: Path) -> None:
    call = (
        "control",
        "--bundle",
        str(bundle),
        "--key",
        PUBLIC,
        "--source",
        "cohort:P1",
        "--steps",
        "5",
        "--speed",
        "fast",
        "--log",
        "/dev/full",
    )
    process = betaloop(*call)
    out, said = process.communicate(timeout=300)
    assert process.returncode == 1
    assert "The log /dev/full cannot be written: No space left on device." in said
    assert "Traceback" not in said
    assert out == ""


def test_a_process_killed_in_the_middle_of_its_loop_leaves_whole_rows(bundle: Path, tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    call = ("control", "--bundle", str(bundle), "--key", PUBLIC, "--source", "cohort:P1", "--steps", "1000000", "--speed", "fast")
    process = betaloop(*call, "--log", str(log))
    try:
        give_up = time.monotonic() + 300
        while (not log.exists() or log.stat().st_size < 20_000) and time.monotonic() < give_up:
            time.sleep(0.02)
    finally:
        process.kill()
        process.communicate()
    assert process.returncode == -signal.SIGKILL
    assert log.read_bytes().endswith(b"\n")
    rows = rows_of(log)
    assert len(rows) > 100
    assert all(None not in row and None not in row.values() for row in rows)
    np.testing.assert_array_equal(np.diff([float(row["t_s"]) for row in rows]), 2.0)


@pytest.mark.hazard("H13")
def test_a_decision_that_comes_a_period_late_is_counted_and_gives_cdbs(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The machine pauses for three periods: what it then decides is about beta that is long past."""
    said = Signal("uV", "time_domain")
    opened = verified(made(tmp_path, period_s=0.1, ramp_ma_per_s=20.0, window=2), PUBLIC)
    run, held = Run(0.1, 3.0), []

    def wait(pause: float) -> None:
        held.append(pause)
        time.sleep(pause + (0.35 if len(held) == 6 else 0.0))

    def rows():  # type: ignore[no-untyped-def]
        for k in range(20):
            yield Row(0.1 * k, BetaSample(0.1 * k, 1.5, said))

    drive(opened, Source(rows(), "x"), run, True, None, wait=wait)
    late = [i for i, d in enumerate(run.decisions) if d.beta_age_s is not None and d.beta_age_s > 0.1]
    assert late
    assert run.missed >= len(late) > 1
    assert all(run.decisions[i].fallback and run.decisions[i].amplitude_ma == 3.0 for i in late)
    assert "deadline missed" in capsys.readouterr().err
    assert not run.decisions[-1].fallback


@pytest.mark.hazard("H08")
@pytest.mark.parametrize("line", ["1_5", "1,5", "0x10", "nan", "inf", "-1", "1e999", "١.٥", "1.5 uV", "\x00"])
def test_a_line_that_is_no_amplitude_is_never_taken_for_one(bundle: Path, line: str) -> None:
    run = Run(2.0, 3.0)
    drive(verified(bundle, PUBLIC), open_source("-", MANIFEST, Wish(), ["1.5"] * 11 + [line]), run, False, None)
    assert run.decisions[-1].fallback
    assert run.decisions[-1].reasons & Reason.INVALID_BETA
    assert not run.decisions[-2].fallback


IMPLANT = {
    "capacity_mah": [180, 220], "voltage_v": 3.7, "other_drain_uw": [50, 150], "impedance_ohm": [800, 1200], "supply_v": [4, 6],
    "pulse_width_us": 60, "rate_hz": 130, "source": "made up for this test",
}  # fmt: skip


def test_the_summary_says_what_the_session_means_for_a_battery_and_under_which_assumptions(bundle: Path, tmp_path: Path) -> None:
    file = tmp_path / "implant.json"
    file.write_text(json.dumps(IMPLANT))
    summary = control(bundle, "cohort:P1:3", Wish(steps=60), Task(key=PUBLIC, battery=file))
    # on cDBS, best case: 3 mA, 800 ohm, 60 us at 130 Hz is 56.2 uW, and 50 uW besides, from 220 mAh at 3.7 V
    assert summary["battery_days_on_cdbs"][1] == pytest.approx(220 * 3.7 * 1000 / (0.003**2 * 800 * 60e-6 * 130 * 1e6 + 50) / 24)
    # worst case: 3 mA from 6 V, and 150 uW besides, from 180 mAh
    assert summary["battery_days_on_cdbs"][0] == pytest.approx(180 * 3.7 * 1000 / (0.003 * 6 * 60e-6 * 130 * 1e6 + 150) / 24)
    assert summary["battery_days"][0] > summary["battery_days_on_cdbs"][0]
    said = lines(summary)
    assert "made up for this test" in said
    assert "assumed: no recording holds it" in said
    for change in (
        {"capacity_mah": [220, 180]},
        {"rate_hz": "130"},
        {"supply_v": None},
        {"source": " "},
        {"impedance_ohm": 0},
        {"colour": 1},
    ):
        file.write_text(json.dumps(IMPLANT | change))
        with pytest.raises(Invalid, match="battery"):
            control(bundle, "cohort:P1:3", Wish(steps=5), Task(key=PUBLIC, battery=file))
    file.write_text("{")
    with pytest.raises(Invalid, match="cannot be read"):
        control(bundle, "cohort:P1:3", Wish(steps=5), Task(key=PUBLIC, battery=file))
