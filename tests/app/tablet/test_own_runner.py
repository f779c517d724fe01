"""A bundle's own runner: it runs what was signed, and a kill or a stop of the system leaves a whole record."""

from __future__ import annotations

import dataclasses
import os
import re
import signal
import socket
import subprocess
import sys
import time
import zipfile
from datetime import datetime, timedelta
from pathlib import Path

import pytest

from app.tablet.command import control
from app.tablet.sources import Task, Wish
from ml.deploy.runtime.device import DeviceSide
from tests.app.tablet.control_bundles import PUBLIC, SLOT, of_slot


def unpacked(bundle: Path, folder: Path) -> Path:
    with zipfile.ZipFile(bundle) as archive:
        archive.extractall(folder / "bundle")
    return folder / "bundle"


def todays(folder: Path, **changes: object) -> Path:
    """Build a bundle of a slot of today, with quick decisions."""
    now = datetime.now().astimezone()
    slot = dataclasses.replace(SLOT, visit_date=now.date().isoformat(), issued_at=(now - timedelta(minutes=1)).isoformat())
    return of_slot(folder, slot=slot, period_s=0.2, window=2, ramp_ma_per_s=50.0, **changes)


def own_runner(folder: Path, *options: str) -> subprocess.Popen[str]:
    call = [sys.executable, "-m", "controller", f"--key={PUBLIC}", f"--ledger={folder / 'ledger'}", *options]
    return subprocess.Popen(
        call, cwd=folder / "bundle", stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, bufsize=1
    )


@pytest.mark.hazard("H16")
@pytest.mark.hazard("H17")
def test_a_runner_killed_in_mid_session_leaves_whole_rows_the_device_on_cdbs_and_the_next_start_says_so(tmp_path: Path) -> None:
    folder, log = unpacked(todays(tmp_path), tmp_path).parent, tmp_path / "log.csv"
    runner = own_runner(folder, "--run", f"--log={log}")
    assert runner.stdin is not None
    assert runner.stdout is not None
    device, began = DeviceSide("P1", "-", 3.0, 0.5, 3.0), time.monotonic()
    runner.stdin.write("hello 1 P1 - uV time_domain 200\n")
    os.set_blocking(runner.stdout.fileno(), False)
    seq = 0
    while device.amplitude_ma == 3.0 and time.monotonic() < began + 20:
        if time.monotonic() - began >= 0.2 * (seq + 1):
            runner.stdin.write(f"beta {seq} {1000 * (time.monotonic() - began):.0f} {1.4 + 0.1 * (seq % 3)} uV time_domain\n")
            seq += 1
        for line in iter(runner.stdout.readline, ""):
            device.hear(line, time.monotonic())
        time.sleep(0.01)
    assert device.why == "policy"
    runner.kill()
    runner.communicate()
    killed = now = time.monotonic()
    while not device.over and now < killed + 5:
        now += 0.01  # the device's own clock, which no other work on this machine holds up
        device.look(now)
    assert (device.amplitude_ma, device.why) == (3.0, "watchdog")
    assert now - killed <= 2.5 * 0.2 + 0.2
    assert runner.returncode == -signal.SIGKILL
    assert log.read_bytes().endswith(b"\n")
    rows = rows_of_quick(log)
    again = own_runner(folder, "--run", f"--log={tmp_path / 'again.csv'}")
    out, said = again.communicate("hello 1 P1 - uV time_domain 200\n", timeout=300)
    assert again.returncode == 1
    assert out == "refused broken_off\n"
    assert f"was broken off after {len(rows)} decisions" in said
    assert "plan a repeat" in said
    assert not (tmp_path / "again.csv").exists()


def rows_of_quick(log: Path) -> list[str]:
    lines = log.read_text("utf-8").splitlines()
    assert all(line.count(",") >= 18 for line in lines[2:])
    return lines[3:]


@pytest.mark.hazard("H15")
def test_the_stop_of_the_system_ends_a_session_over_loopback_on_clinical_settings(tmp_path: Path) -> None:
    folder = unpacked(todays(tmp_path), tmp_path).parent
    runner = own_runner(folder, "--run", "--input=tcp:0", f"--log={tmp_path / 'log.csv'}")
    assert runner.stderr is not None
    said = [runner.stderr.readline() for _ in range(2)]
    port = int(said[-1].split("port ")[1].split()[0])
    with socket.create_connection(("127.0.0.1", port), timeout=10) as link:
        stream = link.makefile("rw", newline="\n")
        assert stream.readline().startswith("controller 1 P1 - 200 3 0.5 3 2")
        with socket.create_connection(("127.0.0.1", port), timeout=10) as second:
            assert second.recv(100) == b"", "one device at a time"
        stream.write("hello 1 P1 - uV time_domain 200\n")
        stream.flush()
        assert stream.readline().startswith("amplitude 0 ")
        runner.send_signal(signal.SIGTERM)
        last = [line for line in stream if line][-1]
    assert last.split()[0::3] == ["end", "3"]
    assert last.split()[4] == "stopped"
    assert runner.wait(300) == 0
    runner.communicate()


@pytest.mark.hazard("H19")
def test_the_bundles_own_runner_runs_nothing_that_was_changed_or_signed_by_another(tmp_path: Path) -> None:
    folder = unpacked(todays(tmp_path), tmp_path)
    manifest = folder / "manifest.json"
    manifest.write_bytes(manifest.read_bytes().replace(b'"max_ma": 3.0', b'"max_ma": 3.4'))
    changed = own_runner(tmp_path, "--run", f"--log={tmp_path / 'log.csv'}")
    _, said = changed.communicate("", timeout=300)
    assert (changed.returncode, "the manifest is not signed with this key" in said) == (1, True)
    assert not (tmp_path / "log.csv").exists()


def test_decisions_are_timed_by_both_runners(tmp_path: Path) -> None:
    unpacked(of_slot(tmp_path), tmp_path)
    for asked, n in ((["--time=50"], 50), (["--time", "60"], 60), (["--time"], 200)):
        out, _ = own_runner(tmp_path, *asked).communicate("", timeout=300)
        found = re.fullmatch(
            r"P1, rl-01, rl, 20 x 10 units: a decision takes ([0-9.]+) ms, SD ([0-9.]+) ms [(]median .* n = (\d+)[)]\n", out
        )
        assert found, out
        assert 0 < float(found[1]) < 100, "milliseconds, and no other unit"
        assert int(found[3]) == n
    summary = control(tmp_path / "bundle.zip", None, Wish(), Task(key=PUBLIC, timed=50))
    assert summary["measured_us"]["n"] == 50
    assert summary["measured_us"]["median"] > 0
