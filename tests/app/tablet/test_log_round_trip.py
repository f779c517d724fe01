"""A controller's log gives back what the device had: each beta with the amplitude that was in force while it was measured."""

from __future__ import annotations

import csv
import hashlib
import re
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient

from app.tablet.command import Run, drive, verified
from app.tablet.sources import Row, Source
from ml.deploy.runtime.control_loop import End
from ml.deploy.runtime.decision_log import COLUMNS, LogFile, kind_line
from ml.deploy.runtime.envelope import BetaSample, Signal
from ml.deploy.runtime.session import describe
from ml.formats import DecodeOptions, UndecodableFile, decode, redact, sniff
from ml.formats.recording import DecodedFile
from ml.formats.tables.columns import LOG_COLUMNS, LOG_KIND_LINE
from ml.formats.tables.log_head import ENDS
from tests.app.tablet.control_bundles import MANIFEST, MORNING, PUBLIC, made

STEPS, LEAD = 40, 10
SIGNAL = Signal("uV", "time_domain")


class Device:
    """A stimulator with a brain: beta answers to the amplitude in force, and both are on record as they were."""

    def __init__(self) -> None:
        self._rng = np.random.default_rng(8)
        self.beta: dict[float, float] = {}
        self.amplitude_ma: dict[float, float] = {}

    def measured(self, t_end_s: float, amplitude_ma: float) -> float:
        """Return beta of the period that ends at `t_end_s` under an amplitude; float32, as every runtime takes it."""
        value = float(np.float32(2.2 - 0.4 * amplitude_ma + 0.3 * self._rng.standard_normal()))
        self.beta[t_end_s], self.amplitude_ma[t_end_s] = max(value, 0.05), amplitude_ma
        return self.beta[t_end_s]


def in_closed_loop(device: Device):  # type: ignore[no-untyped-def]
    amplitude = MANIFEST.cdbs_ma
    for i in range(-LEAD + 1, STEPS + 1):
        t_s = 2.0 * i
        amplitude = yield Row(t_s, BetaSample(t_s, device.measured(t_s, amplitude), SIGNAL))


def same_as_the_device(decoded: DecodedFile, device: Device) -> None:
    (recording,) = decoded.recordings
    beta, amplitude = (next(t for t in recording.traces if t.stream == stream) for stream in ("beta", "amplitude"))
    times = [round(t, 6) for t in beta.t_end_s]
    assert times == list(device.beta)
    np.testing.assert_allclose(beta.values, list(device.beta.values()), rtol=1e-6)
    np.testing.assert_allclose(amplitude.values[1:], list(device.amplitude_ma.values())[1:], rtol=1e-5)  # six digits
    assert np.isnan(amplitude.values[0]), "nothing is known of the time before the first decision"
    assert (beta.unit, beta.source, amplitude.unit, amplitude.source) == ("uV", "time_domain", "mA", "device_log")
    assert recording.kind == "controller_log"


@pytest.fixture
def logged(tmp_path: Path) -> tuple[Device, Path]:
    device, log, opened = Device(), tmp_path / "log.csv", verified(made(tmp_path), PUBLIC)
    facts = describe(opened.manifest_json, opened.manifest_sha256, opened.controller(), MORNING, "replay")
    sink = LogFile(log, 2.0, facts)
    drive(opened, Source(in_closed_loop(device), "a device"), Run(2.0, 3.0), False, sink.write)
    sink.close()
    return device, log


@pytest.mark.hazard("H21")
def test_the_log_of_the_tablet_gives_back_what_the_device_had(logged: tuple[Device, Path], tmp_path: Path) -> None:
    device, log = logged
    assert len(set(device.amplitude_ma.values())) > 5, "the amplitude moves, so that a shift by one step would show"
    assert sniff(log) == "control_log"
    decoded = decode(log)
    same_as_the_device(decoded, device)
    clean = tmp_path / "clean.csv"
    redact(log, clean, "control_log", b"k" * 32)
    same_as_the_device(decode(clean), device)
    assert decode(clean).recordings[0].settings == decoded.recordings[0].settings
    assert decode(clean).recordings[0].fingerprint == decoded.recordings[0].fingerprint
    assert not {"requested_ma", "detail", "window", "policy_name"} & set(re.split(r"[^a-z_]+", clean.read_text()))
    ran = decoded.recordings[0].settings["controller"]
    assert (ran["policy_id"], ran["min_ma"], ran["max_ma"], ran["cdbs_ma"], ran["side"]) == (3, 0.5, 3.0, 3.0, None)


def test_the_log_of_a_bundles_own_runner_gives_back_what_the_device_had(tmp_path: Path) -> None:
    with zipfile.ZipFile(made(tmp_path)) as archive:
        archive.extractall(tmp_path / "bundle")
    call = [sys.executable, "-m", "controller", "--run", "--bench", "--replay", "--log=log.csv"]
    device, amplitude = Device(), MANIFEST.cdbs_ma
    with subprocess.Popen(call, cwd=tmp_path / "bundle", stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as runner:
        assert runner.stdin is not None
        assert runner.stdout is not None
        for k in range(STEPS):
            runner.stdin.write(f"{device.measured(2.0 * k, amplitude):.9g}\n")
            runner.stdin.flush()
            amplitude = float(runner.stdout.readline().split()[0])
        runner.stdin.close()
        assert runner.wait(300) == 0
    same_as_the_device(decode(tmp_path / "bundle" / "log.csv"), device)
    again = subprocess.run(call, cwd=tmp_path / "bundle", input="1\n", capture_output=True, text=True, check=False)
    assert (again.returncode, "log.csv is there already" in again.stderr) == (1, True)


def test_a_runner_whose_reader_went_away_says_so_and_blames_no_log(tmp_path: Path) -> None:
    with zipfile.ZipFile(made(tmp_path)) as archive:
        archive.extractall(tmp_path / "bundle")
    call = [sys.executable, "-m", "controller", "--run", "--bench", "--replay"]
    with subprocess.Popen(
        call, cwd=tmp_path / "bundle", stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    ) as runner:
        assert runner.stdout is not None
        runner.stdout.close()
        runner.stdout = None
        _, said = runner.communicate("1\n1\n1\n", timeout=300)
    assert runner.returncode == 1
    assert said.splitlines()[-1] == "nobody reads the amplitudes any more"


@pytest.mark.hazard("H21")
def test_an_uploaded_log_is_the_session_that_the_device_had(logged: tuple[Device, Path], client: TestClient, participant_code: str) -> None:
    device, log = logged
    client.put(f"/api/v1/participants/{participant_code}/settings", json={"settings": {"cdbs_amplitude_ma": 3.0}})
    data = {"participant": participant_code, "visit": "1", "controller": "other"}
    answer = client.post("/api/v1/uploads", data=data, files={"file": ("log.csv", log.read_bytes())})
    assert answer.status_code == 201, answer.text
    assert "each put to the period that followed it" in answer.json()["report"][0]["understood"][0]
    trace = client.get(f"/api/v1/sessions/{answer.json()['sessions'][0]['id']}/trace").json()
    steps = {t: a for t, a in zip(trace["t_s"], trace["amplitude_ma"], strict=True) if t > 0}
    assert steps == pytest.approx({t: a for t, a in device.amplitude_ma.items() if t > 0})
    # a table of the same rows, unshifted, would be a step off
    with log.open() as stream:
        next(stream)
        next(stream)
        shifted = {float(r["due_s"]): float(r["amplitude_ma"]) for r in csv.DictReader(stream)}
    assert max(abs(shifted[t] - steps[t]) for t in steps) > 0.3


@pytest.mark.hazard("H21")
def test_a_log_without_its_first_line_is_refused_in_words(logged: tuple[Device, Path], client: TestClient, participant_code: str) -> None:
    bare = logged[1].read_bytes().split(b"\n", 2)[2]
    data = {"participant": participant_code, "visit": "1", "controller": "other"}
    answer = client.post("/api/v1/uploads", data=data, files={"file": ("log.csv", bare)})
    assert answer.status_code == 422, answer.text
    assert "the log of a controller without its first line" in answer.text
    assert "with its first line '# betaloop controller log, version 1" in answer.text


@pytest.mark.hazard("H21")
def test_a_log_of_another_participant_is_refused(logged: tuple[Device, Path], client: TestClient, participant_code: str) -> None:
    enrol = client.post("/api/v1/participants", json={"code": "P2"})
    assert enrol.status_code == 201
    assert client.post("/api/v1/participants/P2/visits", json={"number": 1}).status_code == 201
    data = {"participant": "P2", "visit": "1", "confirm": "false"}
    answer = client.post("/api/v1/uploads", data=data, files={"file": ("log.csv", logged[1].read_bytes())})
    assert answer.status_code == 422
    assert "of a session of participant P1, not of P2" in answer.text
    assert client.get("/api/v1/participants/P2/proposals").json() == []


def test_a_log_names_policy_and_limits_of_its_session(
    logged: tuple[Device, Path], client: TestClient, participant_code: str, tmp_path: Path
) -> None:
    with zipfile.ZipFile(tmp_path / "bundle.zip") as bundle:
        network = bundle.read("model.onnx")

    def uploaded(rows: int | None) -> dict[str, Any]:
        sent = {"file": ("log.csv", b"".join(logged[1].read_bytes().splitlines(keepends=True)[:rows]))}
        answer = client.post("/api/v1/uploads", data={"participant": participant_code, "visit": "1", "confirm": "false"}, files=sent)
        assert answer.status_code == 201, answer.text
        body = answer.json()
        (found,) = body["proposals"]
        return found | {"flagged": " ".join(body["report"][0]["flagged"])}

    foreign = uploaded(-3)
    assert (foreign["session"]["controller"], foreign["session"]["policy_id"]) == (None, None)
    assert "a policy (number 3 where its bundle was made) that is none of this participant's" in foreign["flagged"]
    home = f"/api/v1/participants/{participant_code}"
    policy = client.post(f"{home}/policies", data={"name": "rl-01"}, files={"file": ("x.onnx", network)}).json()["id"]
    client.put(f"{home}/settings", json={"settings": {"cdbs_amplitude_ma": 2.5}})
    known = uploaded(None)
    number = known["session"]["id"]
    assert (known["session"]["controller"], known["session"]["policy_id"]) == ("rl", policy)
    assert known["evidence"]["controller"] == "its log names policy rl-01"
    assert "ran with a cDBS amplitude of 3 mA, and the one in force here is 2.5 mA" in known["flagged"]
    answer = client.post(f"/api/v1/proposals/{number}/confirm", json={"version": known["version"]})
    assert answer.status_code == 200, answer.text
    assert answer.json()["session"]["policy_id"] == policy
    conditions = client.get(f"/api/v1/sessions/{number}/conditions").json()
    assert (conditions["min_ma"], conditions["max_ma"]) == (MANIFEST.min_ma, MANIFEST.max_ma)


def test_a_log_of_0_1_0_is_read_once_its_kind_is_said(logged: tuple[Device, Path], tmp_path: Path) -> None:
    old = tmp_path / "old.csv"
    with logged[1].open() as stream, old.open("w") as out:
        next(stream)
        next(stream)
        out.write(f"{LOG_KIND_LINE}\n")
        rows = csv.DictReader(stream)
        writer = csv.DictWriter(out, [c for c in COLUMNS if c not in ("due_s", "source")], extrasaction="ignore")
        writer.writeheader()
        writer.writerows(rows)
    (recording,) = decode(old).recordings
    amplitude = next(t for t in recording.traces if t.stream == "amplitude")
    np.testing.assert_allclose(amplitude.values[1:], list(logged[0].amplitude_ma.values())[1:], rtol=1e-5)  # six digits


@pytest.mark.hazard("H21")
def test_a_late_decision_counts_from_when_it_was_made(tmp_path: Path) -> None:
    log = tmp_path / "late.csv"
    rows = ["0,0,1,uV,,3", "2.5,2,1,uV,,1", "4,4,1,uV,,2", "10,10,1,uV,,2", "12,12,1,uV,invalid_beta,2"]
    log.write_text(f"{LOG_KIND_LINE}\nt_s,due_s,beta,unit,reasons,amplitude_ma\n" + "\n".join(rows) + "\n")
    (recording,) = decode(log).recordings
    beta, amplitude = (next(t for t in recording.traces if t.stream == stream) for stream in ("beta", "amplitude"))
    np.testing.assert_allclose(amplitude.values, [np.nan, 3.0, 1.5, np.nan, np.nan, np.nan, 2.0])
    np.testing.assert_array_equal(beta.valid, [True, True, True, False, False, True, False])


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (lambda text: text.replace("version 3", "version 4", 1), "log of version 4"),
        (lambda text: text.replace("version 3", "version 2", 1), "first line of this controller's log is not whole"),
        (lambda text: text.replace("version 3", "version 1", 1), "without the columns t_s, beta"),
        (
            lambda text: text.replace('"min_ma": 0.5', '"min_ma": "low"', 1),
            "the entry min_ma of this controller's log is missing, or of another kind",
        ),
        (lambda text: text.replace('"min_ma": 0.5, ', "", 1), "the entry min_ma of this"),
        (lambda text: text.replace('"purpose": "replay"', '"purpose": "fun"', 1), "the entry purpose of this"),
        (lambda text: text.replace('"min_ma": 0.5', '"min_ma": 3.5', 1), "limits of 3.5 to 3 mA"),
        (lambda text: text.replace("period 2 s", "period 5 s", 1), "decided every 5 s"),
        (lambda text: text.replace(", period 2 s", "", 1), "first line of this controller's log is not whole"),
        (lambda text: text.replace("amplitude_ma", "amplitude", 1), "without the column amplitude_ma"),
        (lambda text: text.replace(",uV,", ",mV,", 1), "beta of several units"),
        (lambda text: text.replace("2.000,2.000,", "2.000,soon,", 1), "'soon' is no number"),
        (lambda text: "\n".join(text.splitlines()[:3]), "the log has no decision"),
        (lambda text: "\n".join(text.splitlines()[:1]), "first line of this controller's log is not whole"),
    ],
)
def test_what_is_wrong_with_a_log_is_said(logged: tuple[Device, Path], change: Callable[[str], str], words: str) -> None:
    text = logged[1].read_text()
    assert change(text) != text
    logged[1].write_text(change(text))
    with pytest.raises(UndecodableFile, match=words):
        decode(logged[1], options=DecodeOptions())


LIMITS = "limits 0.5 to 3 mA, cDBS 3 mA, ramp 1.5 mA/s"
V2 = f"# betaloop controller log, version 2, period 2 s, policy 3, network {'a' * 64}, side left, {LIMITS}"


def test_a_log_of_version_2_says_policy_and_limits_in_its_first_line(tmp_path: Path) -> None:
    log = tmp_path / "log.csv"
    log.write_text(f"{V2}\nt_s,due_s,beta,unit,amplitude_ma\n2,2,1,uV,3\n4,4,1,uV,3\n")
    (recording,) = decode(log).recordings
    said = recording.settings["controller"]
    assert (said["policy_id"], said["network_sha256"], said["side"], said["min_ma"]) == (3, "a" * 64, "left", 0.5)
    assert (recording.hemisphere, recording.started_at, said["slot_id"]) == ("left", None, None)
    for spoilt in (V2.replace("0.5 to 3 mA", "0.5 mA"), V2[:-5]):
        log.write_text(f"{spoilt}\nt_s,due_s,beta,unit,amplitude_ma\n2,2,1,uV,3\n")
        with pytest.raises(UndecodableFile, match="is not whole"):
            decode(log)


def test_the_words_of_decoder_and_writer_agree(logged: tuple[Device, Path], tmp_path: Path) -> None:
    assert kind_line(2.0) == LOG_KIND_LINE.replace("version 1", "version 3")
    assert set(COLUMNS) >= LOG_COLUMNS
    assert {end.value for end in End} == set(ENDS)
    said = decode(logged[1]).recordings[0].settings["controller"]
    network = zipfile.ZipFile(tmp_path / "bundle.zip").read("model.onnx")
    assert said["network_sha256"] == hashlib.sha256(network).hexdigest()
    assert {name: said[name] for name in ("policy_id", "min_ma", "max_ma", "cdbs_ma", "ramp_ma_per_s")} == {
        name: getattr(MANIFEST, name) for name in ("policy_id", "min_ma", "max_ma", "cdbs_ma", "ramp_ma_per_s")
    }
