"""A device's signs for `no reading` in every field of every format: none of them becomes a number that a person or a policy reads."""

from __future__ import annotations

import json
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from ml.formats import RecordingLog, decode
from ml.formats.facts.sentinels import WIDE
from ml.formats.percept.details import groups, limits, montage, snapshot
from ml.formats.rcs.settings import limits_of

PROGRAM = {
    "HemisphereLocation": "HemisphereLocationDef.Left",
    "AmplitudeInMilliAmps": 0,
    "LowerLimitInMilliAmps": 0,
    "UpperLimitInMilliAmps": 0,
    "RateInHertz": 0,
    "PulseWidthInMicroSecond": 0,
    "LowerLfpThreshold": 0,
    "UpperLfpThreshold": 0,
    "SuspendAmplitudeInMilliAmps": 0,
    "FrequencyInHertz": 0,
    "AveragingDurationInMilliSeconds": 0,
    "SensingSetup": {"FrequencyInHertz": 0, "AveragingDurationInMilliSeconds": 0},
    "ElectrodeState": [],
}


def fill(node: Any, value: float) -> Any:
    """Put a value in the place of every number."""
    if isinstance(node, dict):
        return {key: fill(item, value) for key, item in node.items()}
    return [fill(item, value) for item in node] if isinstance(node, list) else value if isinstance(node, int) else node


def numbers(node: Any) -> Iterator[float]:
    """List all numbers of a value."""
    if isinstance(node, dict | list | tuple):
        for item in node.values() if isinstance(node, dict) else node:
            yield from numbers(item)
    elif isinstance(node, int | float) and not isinstance(node, bool):
        yield float(node)


@pytest.mark.parametrize("sentinel", WIDE)
def test_no_setting_of_a_percept_is_a_sentinel(sentinel: float) -> None:
    program = fill(PROGRAM, sentinel)
    group = {"GroupId": "GroupIdDef.GROUP_A", "ProgramSettings": {"RateInHertz": sentinel, "SensingChannel": [program]}}
    side = {"ActiveGroup": "GroupIdDef.GROUP_A", "HighPassFilterInHertz": sentinel, "Left": program}
    survey = {"LFPFrequency": [1.0, 2.0], "LFPMagnitude": [sentinel, 0.5], "PeakFrequencyInHertz": sentinel}
    read = [groups([group]), snapshot(side, "left"), limits(side, "left"), montage([survey])]
    assert [n for n in numbers(read) if n in WIDE] == []
    assert groups([fill(group, 2)])[0]["programs"][0]["upper_ma"] == 2


def test_limits_of_an_rcs_that_are_no_amplitude_limit_nothing() -> None:
    def make_limits(low: float, high: float) -> dict[str, Any]:
        return {"AmplitudeLimitsGroup0": {"prog0LowerInMilliamps": low, "prog0UpperInMilliamps": high}}

    assert [limits_of(make_limits(0, bad), 0, 0) for bad in (25.5, *WIDE)] == [None] * 5
    assert limits_of(make_limits(0, 4), 0, 0) == (0, 4)


@pytest.fixture
def stream(tmp_path: Any) -> Any:
    """Decodes a session folder with one stream, packets 0.1 s apart."""

    def make(key: str, name: str, body: dict[str, Any], odd: dict[str, Any]) -> RecordingLog:
        packets = []
        for i in range(200):
            tick = 30_000 + 1000 * (i + 1)
            head = {"dataTypeSequence": i % 256, "systemTick": tick % 65_536, "timestamp": {"seconds": 700_000_000 + tick // 10_000}}
            at = 1_767_600_000_000 + 100 * (i + 1)
            packets.append({"Header": head, "PacketGenTime": at, "PacketRxUnixTime": at + 40, **(odd if i % 20 == 7 else body)})
        folder = tmp_path / "Session1767600000000" / "DeviceNPC799999H"
        folder.mkdir(parents=True, exist_ok=True)
        (folder / f"{name}.json").write_text(json.dumps([{"RecordInfo": {"HostUnixTime": 1_767_600_000_000}, key: packets}]))
        sensing = {
            "fftConfig": {"interval": 100, "size": 1},
            "timeDomainChannels": [{"sampleRate": 0, "plusInput": 4, "minusInput": 1}] * 4,
        }
        settings = [{"RecordInfo": {"HostUnixTime": 1_767_599_995_000}, "SensingConfig": sensing}]
        (folder / "DeviceSettings.json").write_text(json.dumps(settings))
        (recording,) = decode(tmp_path).recordings
        return recording

    return make


def test_a_band_of_an_rcs_without_a_reading_is_a_gap(stream: Any) -> None:
    def bands(value: int) -> dict[str, Any]:
        return {"Bands": [value] * 8, "ValidDataMask": 255, "IsPowerChannelOverrange": False, "FftSize": 1, "SampleRate": 0}

    recording = stream("PowerDomainData", "RawDataPower", bands(600), bands(2**32 - 1))
    powers = [t for t in recording.traces if t.stream == "band_power"]
    assert powers
    assert {round(float(v)) for t in powers for v in t.values[t.valid]} == {600}
    assert all(t.details["spike_packets"] == 0 for t in powers)


@pytest.mark.parametrize("sentinel", [32_767, -32_768, 2**31 - 1])
def test_a_movement_of_an_rcs_without_a_reading_is_a_gap(stream: Any, sentinel: int) -> None:
    def movement(last: int) -> dict[str, Any]:
        return {"SampleRate": 0, "Units": "centiG", **{axis: [1.0] * 7 + [last] for axis in ("XSamples", "YSamples", "ZSamples")}}

    recording = stream("AccelData", "RawDataAccel", movement(1), movement(sentinel))
    (trace,) = [t for t in recording.traces if t.stream == "acceleration"]
    assert np.nanmax(trace.values) < 1
