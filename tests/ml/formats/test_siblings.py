"""Siblings of faults that were reported: other sentinels, counters, clocks and units of the same kinds, through the real decoders."""

from __future__ import annotations

import copy
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ml import formats
from ml.formats import DecodedFile, DecodeOptions, UndecodableFile
from tests.ml.formats.conftest import Percept, Rcs, info

STEPS = 60
RNG = np.random.default_rng(0)
BETA = np.round(RNG.uniform(0.8, 1.6, STEPS), 3).tolist()
AMPLITUDE = np.round(RNG.uniform(0.5, 3.0, STEPS), 1).tolist()
ON = {"therapyStatusData": {"activeGroup": 0, "therapyStatus": 1}}

Read = Callable[[str | bytes], DecodedFile]


@pytest.fixture
def read(tmp_path: Path) -> Read:
    """Clean and decode a file as an upload does."""

    def go(content: str | bytes) -> DecodedFile:
        source, clean = tmp_path / "source", tmp_path / "clean"
        source.write_bytes(content if isinstance(content, bytes) else content.encode())
        options = DecodeOptions(table_beta_unit="uV")
        kind = formats.sniff(source)
        formats.redact(source, clean, kind, bytes(32), options)
        return formats.decode(clean, kind, options)

    return go


def table(header: str, *columns: Sequence[Any]) -> str:
    """Write a CSV table."""
    return "\n".join([header, *(",".join(map(str, row)) for row in zip(*columns, strict=True))]) + "\n"


def steps(beta: Sequence[float] = BETA, amplitude: Sequence[float] = AMPLITUDE) -> str:
    """Write a table of steps from 2 s on."""
    return table("t_s,beta,amplitude_ma", [2 * k for k in range(1, STEPS + 1)], beta, amplitude)


def trace(file: DecodedFile, stream: str) -> np.ndarray:
    """Find the only trace of a stream, with NaN where it is invalid."""
    (found,) = (t for r in file.recordings for t in r.traces if t.stream == stream)
    return np.where(found.valid, found.values, np.nan)


def flags(file: DecodedFile) -> str:
    """Join everything that the reports flag."""
    return "; ".join(text for report in file.reports for text in report.flagged)


@pytest.mark.parametrize("fill", [65_535, 9_999, -999, -1, 2_147_483_647])
def test_a_fill_value_among_beta_is_a_gap(read: Read, fill: float) -> None:
    found = read(steps(beta=[*BETA[:10], fill, *BETA[11:]]))
    beta = trace(found, "beta")
    assert np.isnan(beta[10])
    assert np.nanmax(beta) < 2
    assert "a sign for no value" in flags(found) or "beyond" in flags(found)


def test_a_value_that_others_come_near_to_is_no_fill_value(read: Read) -> None:
    beta = [x * 1000 for x in BETA[:-1]] + [9_999.0]
    assert not np.isnan(trace(read(steps(beta=beta)), "beta")).any()


def test_the_stimulators_sign_for_no_amplitude_is_none_in_a_table(read: Read) -> None:
    found = read(steps(amplitude=[*AMPLITUDE[:10], 25.5, *AMPLITUDE[11:]]))
    assert np.isnan(trace(found, "amplitude")[10])
    assert "sign for no amplitude" in flags(found)


def samples(n: int = 10_000) -> np.ndarray:
    """Make a beta rhythm with noise at 250 Hz, uV."""
    return np.round(10 * np.sin(2 * np.pi * 20 * np.arange(n) / 250) + np.random.default_rng(1).normal(0, 2, n), 3)


@pytest.mark.parametrize("fill", [-9999, 32_767, -32_768, 0])
def test_filled_samples_of_a_table_are_gaps(read: Read, fill: float) -> None:
    x = samples()
    x[1000:1500] = fill
    found = read(table("t_s,lfp [uV]", np.round(np.arange(x.size) / 250, 4), x))
    beta = trace(found, "beta")
    assert np.isnan(beta[2])
    assert 6 < np.nanmin(beta) < np.nanmax(beta) < 8
    assert "gaps" in flags(found)


def test_a_table_with_two_rates_is_refused(read: Read) -> None:
    t = np.concatenate([np.arange(5000) / 250, 20 + np.arange(5000) / 500])
    with pytest.raises(UndecodableFile, match="the sampling rate changes: 250 Hz here, 333"):
        read(table("t_s,lfp [uV]", np.round(t, 4), samples()))


def test_grasps_in_milliseconds_are_no_grasps_in_seconds(read: Read) -> None:
    with pytest.raises(UndecodableFile, match="every 1000 s"):
        read(table("t_s", [1000 * k for k in range(1, 20)]))


@pytest.mark.parametrize("fill", [0, -1, 32_767])
def test_samples_of_a_percept_that_stand_still_are_gaps(read: Read, percept: Percept, fill: float) -> None:
    report = percept.one_run(seconds=60)
    report["BrainSenseTimeDomain"][0]["TimeDomainData"][1000:2000] = [fill] * 1000
    found = read(json.dumps(report))
    beta = trace(found, "beta")
    assert np.isnan(beta[[2, 3]]).all()
    np.testing.assert_allclose(beta[5:], 3 / np.sqrt(2), rtol=0.01)
    assert "stand still" in flags(found)


def test_a_session_date_without_its_zone_gives_no_clock(read: Read, percept: Percept) -> None:
    report = percept.one_run() | {"SessionDate": "2024-03-14T11:00:00", "SessionEndDate": "2024-03-14T11:20:00"}
    report["DeviceInformation"]["Initial"]["DeviceDateTime"] = "2024-03-14T10:00:05Z"
    found = read(json.dumps(report))
    assert found.recordings[0].settings["clock"]["known"] is False
    assert "have no zone, and may be local time" in flags(found)


@pytest.mark.parametrize(("moment", "known"), [("2024-03-14T10:06:10Z", False), ("2024-03-14T12:06:10Z", True)])
def test_a_switch_to_a_cycling_group_in_a_run_makes_its_amplitude_unknown(read: Read, percept: Percept, moment: str, known: bool) -> None:
    report = percept.one_run(seconds=60)
    change = {"DateTime": moment, "NewGroupId": "GroupIdDef.GROUP_A", "OldGroupId": "GroupIdDef.GROUP_B"}
    report["DiagnosticData"] = {"EventLogs": [change | {"ParameterTrendId": "ParameterTrendIdDef.ActiveGroup"}]}
    group = {"GroupId": "GroupIdDef.GROUP_A", "ActiveGroup": False, "GroupSettings": {"Cycling": {"Enabled": True}}}
    still = {"GroupId": "GroupIdDef.GROUP_B", "ActiveGroup": True, "GroupSettings": {"Cycling": {"Enabled": False}}}
    report["Groups"] = {"Initial": [group, still]}
    found = read(json.dumps(report))
    assert bool(np.isfinite(trace(found, "amplitude")).all()) == known
    assert ("group A cycles" in flags(found)) != known


def session(pack: Any, rcs: Rcs, stim: list[Any], settings: list[Any] | None = None, x: np.ndarray | None = None) -> bytes:
    """Zip an RC+S session of 60 s."""
    signal = 0.01 * np.sin(2 * np.pi * 20 * np.arange(500 * 60) / 500) if x is None else x
    parts = {"RawDataTD": rcs.time_domain(signal), "DeviceSettings": settings or rcs.settings(), "StimLog": stim}
    path: Path = pack({f"Session1/DeviceNPC799999H/{stem}.json": content for stem, content in parts.items()})
    return path.read_bytes()


def allowing(rcs: Rcs, ma: float) -> list[Any]:
    """Make settings whose own amplitude is within the clinician's limits."""
    settings = rcs.settings()
    for program in settings[0]["TherapyConfigGroup0"]["programs"]:
        program["amplitudeInMilliamps"] = ma
    return settings


@pytest.mark.parametrize("value", [None, float("nan"), 25.5, 65_535, -1])
def test_what_the_log_cannot_say_is_not_taken_from_older_settings(read: Read, pack: Any, rcs: Rcs, value: Any) -> None:
    stim = rcs.stim((-4, {**ON, **rcs.program(2.0)}), (20, {"TherapyConfigGroup0": {"program0": {"AmplitudeInMilliamps": value}}}))
    found = read(session(pack, rcs, stim, allowing(rcs, 2.0)))
    amplitude = trace(found, "amplitude")
    np.testing.assert_allclose(amplitude[:10], 2.0)
    assert np.isnan(amplitude[10:]).all()
    assert "amplitude" in flags(found)


@pytest.mark.parametrize("scale", [1e-3, 1e3, 0.0])
def test_a_log_whose_times_are_of_another_unit_is_not_believed(read: Read, pack: Any, rcs: Rcs, scale: float) -> None:
    stim = copy.deepcopy(rcs.stim((-4, {**ON, **rcs.program(2.0)}), (20, rcs.program(1.0))))
    for record in stim:
        record["RecordInfo"]["HostUnixTime"] = int(scale * record["RecordInfo"]["HostUnixTime"])
    found = read(session(pack, rcs, stim, allowing(rcs, 2.0)))
    known = [t for r in found.recordings for t in r.traces if t.stream == "amplitude" and t.valid.any()]
    assert known == []
    assert "records are lost" in flags(found)


def test_a_record_without_a_time_ends_what_the_log_vouches_for(read: Read, pack: Any, rcs: Rcs) -> None:
    stim = [
        *rcs.stim((-4, {**ON, **rcs.program(2.0)}), (20, rcs.program(1.5))),
        {"RecordInfo": info(0), **rcs.program(1.0)},
        *rcs.stim((40, rcs.program(2.5))),
    ]
    amplitude = trace(read(session(pack, rcs, stim)), "amplitude")
    np.testing.assert_allclose(amplitude[:10], 2.0)
    assert np.isnan(amplitude[10:20]).all()


def test_samples_of_an_rcs_that_stand_still_are_gaps(read: Read, pack: Any, rcs: Rcs) -> None:
    x = 0.01 * np.sin(2 * np.pi * 20 * np.arange(500 * 60) / 500)
    x[5000:15_000] = 0.0
    found = read(session(pack, rcs, rcs.stim((-4, {**ON, **rcs.program(2.0)})), x=x))
    beta = trace(found, "beta")
    assert np.isnan(beta[6:14]).all()
    np.testing.assert_allclose(beta[[0, 1, 20, 29]], 10 / np.sqrt(2), rtol=0.01)
    assert "stand still" in flags(found)
