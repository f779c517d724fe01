"""`betaloop control`: bundles verified, recordings and synthetic participants driven, every decision logged."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
import time
from pathlib import Path

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey
from typer.testing import CliRunner

from app.cli import app as command_line
from app.platform.errors import Invalid, NotFound
from app.settings import get_settings
from app.tablet.command import Run, control, drive, verified
from app.tablet.sources import Row, Source, Task, Wish, open_source
from ml.deploy.bundle import build_bundle, sign
from ml.deploy.runtime.decision_log import Row as LogRow
from ml.deploy.runtime.envelope import BetaSample, Signal
from ml.formats import decode
from ml.rl import MlpPolicy
from tests.app.tablet.control_bundles import MANIFEST, PUBLIC, made, rows_of


@pytest.fixture
def bundle(tmp_path: Path) -> Path:
    return made(tmp_path)


def test_a_synthetic_participant_is_driven_in_closed_loop_and_the_same_seed_gives_the_same(bundle: Path, tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    summary = control(bundle, "cohort:P1:3", Wish(steps=60), Task(log=log, key=PUBLIC))
    again = control(bundle, "cohort:P1:3", Wish(steps=60), Task(log=None, key=PUBLIC))
    assert (summary["decisions"], summary["fallbacks"], summary["deadline_misses"]) == (70, 9, 0)
    assert summary["mean_amplitude_ma"] == again["mean_amplitude_ma"]
    rows = rows_of(log)
    assert len(rows) == 70
    amplitudes = np.array([float(row["amplitude_ma"]) for row in rows])
    assert summary["mean_amplitude_ma"] == pytest.approx(amplitudes.mean(), abs=1e-5)
    assert summary["energy_of_cdbs"] == pytest.approx(np.mean((amplitudes / 3.0) ** 2), abs=1e-5)
    assert summary["energy_saved_percent"] == pytest.approx(100 * (1 - summary["energy_of_cdbs"]))
    assert [row["action"] for row in rows] == ["cdbs"] * 9 + ["policy"] * 61
    assert np.abs(np.diff(amplitudes)).max() <= 1.0 + 1e-4
    policy = verified(bundle, PUBLIC).network
    for row in rows[9:]:
        window = [float(beta) for beta in row["window"].split()]
        assert window[-1] == pytest.approx(float(row["beta"]), rel=1e-5)  # six digits
        for beta in window:
            policy.push(beta)
        assert policy.fraction() == pytest.approx(float(row["fraction"]), abs=1e-3)  # the log rounds beta to six digits


def test_the_amplitude_decided_is_the_one_that_the_participant_feels(bundle: Path) -> None:
    opened = verified(bundle, PUBLIC)
    low = dataclasses.replace(opened, manifest=dataclasses.replace(opened.manifest, min_ma=2.99))
    means = []
    for which in (opened, low):
        run = Run(2.0, 3.0)
        source = open_source("cohort:P1:1", opened.manifest, Wish(steps=100), [])
        beta: list[float] = []
        drive(which, dataclasses.replace(source, rows=_seen(source, beta)), run, False, None)
        means.append((np.mean([d.amplitude_ma for d in run.decisions]), np.mean(beta)))
    assert means[0][0] < means[1][0]
    assert means[0][1] > means[1][1], "less stimulation, more beta"


def _seen(source: Source, beta: list[float]):  # type: ignore[no-untyped-def]
    row = next(source.rows)
    while True:
        assert row.sample is not None
        beta.append(row.sample.beta)
        try:
            row = source.rows.send((yield row))
        except StopIteration:
            return


def test_raw_lfp_goes_through_p_beta_to_the_amplitude(bundle: Path, tmp_path: Path) -> None:
    rng, rate = np.random.default_rng(2), 250.0
    t = np.arange(int(80 * rate)) / rate
    x = (1 + np.sin(2 * np.pi * t / 25)) * 3 * np.sin(2 * np.pi * 20 * t) + rng.normal(size=t.size)
    x[int(41 * rate) : int(43 * rate)] = np.nan
    table = tmp_path / "lfp.csv"
    table.write_text(
        "t_s,lfp [uV]\n" + "".join(f"{a:.4f},{'' if math.isnan(b) else round(float(b), 4)}\n" for a, b in zip(t, x, strict=True))
    )
    summary = control(bundle, str(table), Wish(), Task(log=tmp_path / "log.csv", key=PUBLIC))
    assert summary["decisions"] == 40
    assert summary["policy"] == 11 + 9, "10 periods to begin with, 10 after the gap of two"
    assert summary["reasons"]["invalid_beta"] == 2
    assert summary["streaming_correlation"] > 0.995
    assert summary["streaming_mean_percent"] < 2
    assert summary["signal_us"]["median"] > 0
    millivolts = tmp_path / "mv.csv"
    body = "".join(f"{a:.4f},{b / 1000:.8f}\n" for a, b in zip(t, x, strict=True) if not math.isnan(b))
    millivolts.write_text("t_s,lfp [mV]\n" + body)
    again = control(bundle, str(millivolts), Wish(), Task(log=None, key=PUBLIC))
    assert again["mean_amplitude_ma"] == pytest.approx(summary["mean_amplitude_ma"], abs=0.01)


TABLE = "t_s,beta [uV],amplitude_fraction\n" + "".join(f"{2 * (k + 1)},{1 + 0.5 * (k % 3)},1\n" for k in range(30))


def test_a_table_of_another_source_is_not_trusted_unless_it_is_said_what_it_holds(bundle: Path, tmp_path: Path) -> None:
    table = tmp_path / "steps.csv"
    table.write_text(TABLE)
    refused = control(bundle, str(table), Wish(), Task(log=None, key=PUBLIC))
    assert refused["fallbacks"] == refused["decisions"] == refused["reasons"]["wrong_signal"] == 30
    assert refused["energy_saved_percent"] == pytest.approx(0.0)
    taken = control(bundle, str(table), Wish(beta_source="time_domain"), Task(log=None, key=PUBLIC))
    assert (taken["fallbacks"], taken["policy"]) == (9, 21)
    table.write_text(TABLE.replace("[uV]", "[mV]"))
    assert control(bundle, str(table), Wish(beta_source="time_domain"), Task(log=None, key=PUBLIC))["policy"] == 0


def test_lines_on_standard_input_are_decided_on_and_what_is_no_number_is_said(bundle: Path) -> None:
    lines = ["1.5"] * 12 + ["", "oops"] + ["1.5"] * 10
    source = open_source("-", MANIFEST, Wish(), lines)
    run = Run(2.0, 3.0)
    drive(verified(bundle, PUBLIC), source, run, False, None)
    assert [d.fallback for d in run.decisions] == [True] * 9 + [False] * 3 + [True] * 11 + [False]


def test_a_late_decision_is_counted_and_shown_and_real_time_waits_until_each_is_due(
    bundle: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    signal = Signal("uV", "time_domain")

    def rows(slow_at: int):  # type: ignore[no-untyped-def]
        for k in range(4):
            yield Row(0.05 * k, BetaSample(0.05 * k, 1.0, signal), signal_us=1e5 if k == slow_at else 0.0)

    opened = verified(bundle, PUBLIC)
    run, waited = Run(0.05, 3.0), []
    drive(opened, Source(rows(2), "x"), run, True, None, wait=lambda s: (waited.append(s), time.sleep(s)))  # type: ignore[func-returns-value]
    assert run.missed == 1
    assert "deadline missed: the decision of 0.100 s" in capsys.readouterr().err
    assert run.worst_late_ms >= 100
    assert sum(waited) == pytest.approx(0.15, abs=0.08)
    fast = Run(0.05, 3.0)
    drive(opened, Source(rows(9), "x"), fast, False, None, wait=lambda s: pytest.fail("fast does not wait"))
    assert fast.missed == 0


def test_the_log_is_written_row_by_row(bundle: Path) -> None:
    rows: list[LogRow] = []
    seen: list[int] = []
    signal = Signal("uV", "time_domain")

    def coming():  # type: ignore[no-untyped-def]
        for k in range(3):
            seen.append(len(rows))
            yield Row(2.0 * k, BetaSample(2.0 * k, 1.0, signal))

    drive(verified(bundle, PUBLIC), Source(coming(), "x"), Run(2.0, 3.0), False, rows.append)
    assert seen == [0, 1, 2]


@pytest.mark.hazard("H19")
def test_a_bundle_that_was_touched_or_signed_by_another_is_not_run(bundle: Path, tmp_path: Path) -> None:
    with pytest.raises(Invalid, match="must not be used: the signature"):
        verified(bundle, Ed25519PrivateKey.generate().public_key().public_bytes_raw().hex())
    content = bundle.read_bytes()
    for at in range(0, len(content), 4999):
        (tmp_path / "touched.zip").write_bytes(content[:at] + bytes([content[at] ^ 1]) + content[at + 1 :])
        try:
            touched = verified(tmp_path / "touched.zip", PUBLIC)
        except Invalid:
            continue
        assert touched.manifest == verified(bundle, PUBLIC).manifest, "a byte that says nothing, such as a time in the directory"


def test_the_key_comes_from_the_call_a_file_or_this_installation(bundle: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "key.txt").write_text(PUBLIC + "\n")
    assert verified(bundle, str(tmp_path / "key.txt")).manifest.participant == "P1"
    for bad in ("nonsense", str(bundle), str(tmp_path)):
        with pytest.raises(Invalid, match="key"):
            verified(bundle, bad)
    monkeypatch.setenv("BETALOOP_DATA_DIR", str(tmp_path / "data"))
    get_settings.cache_clear()
    try:
        with pytest.raises(Invalid, match="does not know the key"):
            verified(bundle, None)
        assert not (tmp_path / "data").exists(), "looking for a key makes none"
        own = Ed25519PrivateKey.from_private_bytes(get_settings().secret("bundle-signing"))
        unnamed = tmp_path / "own.zip"
        policy = MlpPolicy(10, (3,), seed=1)
        unnamed.write_bytes(sign(build_bundle(policy.to_onnx(), dataclasses.replace(MANIFEST, public_key=None), np.ones((1, 10))), own))
        assert verified(unnamed, None).manifest.policy_id == 3
    finally:
        get_settings.cache_clear()


def test_unknown_sources_and_files_are_said_by_name(bundle: Path, tmp_path: Path) -> None:
    (tmp_path / "empty.csv").write_text("")
    for source, message in [("cohort:P9", "synthetic participant"), ("cohort:", "synthetic"), ("nowhere.zip", "no file nowhere.zip")]:
        with pytest.raises(NotFound, match=message):
            control(bundle, source, Wish(), Task(log=None, key=PUBLIC))
    with pytest.raises(Invalid, match="empty"):
        control(bundle, str(tmp_path / "empty.csv"), Wish(), Task(log=None, key=PUBLIC))
    with pytest.raises(Invalid, match="cannot be read"):
        control(tmp_path / "none.zip", None, Wish(), Task(log=None, key=PUBLIC))
    with pytest.raises(Invalid, match="log"):
        control(bundle, "cohort:P1", Wish(steps=5), Task(log=tmp_path / "no" / "log.csv", key=PUBLIC))


@pytest.mark.hazard("H02")
def test_a_recording_of_the_other_hemisphere_is_not_used(tmp_path: Path) -> None:
    from ml.population import rcs_session_zip, run_session

    content = rcs_session_zip(run_session("P1", "cdbs", steps=15, seed=1, resolution_ma=0.1), started_ms=1_772_000_000_000)
    (tmp_path / "session.zip").write_bytes(content)
    (recording,) = decode(tmp_path / "session.zip").recordings
    assert recording.hemisphere is not None
    other = "left" if recording.hemisphere == "right" else "right"
    summary = control(made(tmp_path, hemisphere=recording.hemisphere), str(tmp_path / "session.zip"), Wish(), Task(log=None, key=PUBLIC))
    assert summary["decisions"] >= 15
    with pytest.raises(Invalid, match=f"of the {other} hemisphere"):
        control(made(tmp_path, hemisphere=other), str(tmp_path / "session.zip"), Wish(), Task(log=None, key=PUBLIC))


def test_the_command_says_in_words_and_as_json_and_its_exit_code(bundle: Path) -> None:
    runner = CliRunner()
    only = runner.invoke(command_line, ["control", "--bundle", str(bundle), "--key", PUBLIC])
    assert only.exit_code == 0
    assert "signature, 25 files and test vectors are right" in only.output
    assert "NOT APPROVED" in only.output
    call = ["control", "--bundle", str(bundle), "--key", PUBLIC, "--source", "cohort:P2:1", "--steps", "20", "--speed", "fast"]
    words = runner.invoke(command_line, call)
    for part in ("decisions        30: 9 on cDBS", "deadline misses  0", "mean amplitude", "of cDBS"):
        assert part in words.output
    body = json.loads(runner.invoke(command_line, [*call, "--json"]).output)
    assert (body["decisions"], body["fallbacks"]) == (30, 9)
    assert runner.invoke(command_line, [*call, "--speed", "slow"]).exit_code == 2


def valid_runs(streamed: list[float]) -> int:
    """Count the decisions that a window of 10 leaves to the policy."""
    runs = [len(list(group)) for valid, group in itertools.groupby(math.isfinite(v) for v in streamed) if valid]
    return sum(max(0, length - 9) for length in runs)


def test_a_real_recording_with_packet_loss_is_driven_from_its_raw_lfp(tmp_path: Path, recordings: Path) -> None:
    for window in (2, 10):
        bundle = made(tmp_path, window=window)
        opened = verified(bundle, PUBLIC)
        source = open_source(str(recordings / "rcs" / "montage_packet_loss.zip"), opened.manifest, Wish(channel="key 2 +9-8"), [])
        run = Run(2.0, 3.0)
        drive(opened, source, run, False, None)
        summary = run.summary(source)
        assert summary["decisions"] == 104
        assert summary["streaming_correlation"] > 0.99
        assert summary["streaming_n"] >= 18
        asked = summary["decisions"] - summary["fallbacks"]
        if window == 10:
            assert asked == valid_runs(source.streamed)
        else:
            assert asked > 0
        assert all(0.5 <= d.amplitude_ma <= 3.0 for d in run.decisions)


@pytest.mark.parametrize(("most", "least", "highest"), [(0, 0.0, 0.4), (2, 0.8, 1.0)])
def test_on_a_recording_with_heavy_loss_the_policy_decides_in_four_periods_of_five(
    tmp_path: Path, recordings: Path, most: int, least: float, highest: float
) -> None:
    opened = verified(made(tmp_path, most_imputed=most, carried_over=0.5), PUBLIC)
    pairs = ["+1-0 +2-0 +3-0 +3-1", "+2-1 +3-1 +3-2", "+10-8 +11-9 +9-8", "+11-10 +11-8 +11-9"]
    asked: list[bool] = []
    for channel in (f"key {key} {pair}" for key, named in enumerate(pairs) for pair in named.split()):
        source = open_source(str(recordings / "rcs" / "montage_packet_loss.zip"), opened.manifest, Wish(channel=channel), [])
        run = Run(2.0, 3.0)
        drive(opened, source, run, False, None)
        known = np.flatnonzero(np.isfinite(source.streamed))
        assert all(d.amplitude_ma == 3.0 for k, d in enumerate(run.decisions) if k not in known), "no amplitude on stale beta"
        for sensed in np.split(known, np.flatnonzero(np.diff(known) > 5) + 1):  # a montage senses a pair for 40 s
            asked += [not d.fallback for d in run.decisions[sensed[0] + 9 : sensed[-1] + 1]]
    assert len(asked) > 100
    assert least <= np.mean(asked) <= highest


def test_a_real_stimulation_sweep_is_driven_from_the_devices_own_band_power(tmp_path: Path, recordings: Path) -> None:
    sweep = str(recordings / "rcs" / "stim_sweep.zip")
    with pytest.raises(NotFound, match="no channel"):
        control(made(tmp_path), sweep, Wish(channel="key 9"), Task(log=None, key=PUBLIC))
    wrong = control(made(tmp_path), sweep, Wish(), Task(log=None, key=PUBLIC))
    assert wrong["fallbacks"] == wrong["decisions"] == 222
    right = control(made(tmp_path, beta_unit="device units", beta_source="device_power"), sweep, Wish(), Task(log=None, key=PUBLIC))
    (recording,) = decode(recordings / "rcs" / "stim_sweep.zip").recordings
    band = max((t for t in recording.traces if t.source == "device_power"), key=lambda t: int(t.valid.sum()))
    assert right["policy"] == valid_runs(np.where(band.valid, band.values, np.nan).tolist()) > 50
    assert right["deadline_misses"] == 0


def test_the_command_has_help_with_an_example() -> None:
    result = CliRunner().invoke(command_line, ["control", "--help"])
    assert result.exit_code == 0
    assert "Example: betaloop control" in result.output
