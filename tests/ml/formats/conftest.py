from __future__ import annotations

import dataclasses
import json
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

START_MS = 1_700_000_000_000
DEVICE_START_S = 700_000_000
SERIAL = "NPC799999H"
RATE_CODES = {250: 0, 500: 1, 1000: 2}


def info(ms: float = START_MS) -> dict[str, Any]:
    return {"ApiVer": "1.6.0.0", "DeviceId": SERIAL, "HostUnixTime": int(ms), "SessionId": str(START_MS)}


def header(index: int, t_s: float, size: int, kind: int = 1) -> dict[str, Any]:
    """Build the header of packet number `index` whose last sample is t_s after the start."""
    ticks = round((3.0 + t_s) * 10_000)
    return {
        "dataSize": size,
        "dataType": kind,
        "dataTypeSequence": index % 256,
        "globalSequence": index % 256,
        "info": 0,
        "systemTick": ticks % 65_536,
        "timestamp": {"seconds": DEVICE_START_S + int(3.0 + t_s)},
        "user1": 1,
        "user2": 1,
    }


class Rcs:
    """A small session: sine in the time domain, its settings, a stimulation log."""

    start_ms = START_MS
    serial = SERIAL

    def time_domain(self, x_mv: np.ndarray, rate: int = 500, per_packet: int = 50, lost: Iterable[int] = (), gen: bool = True) -> list[Any]:
        gone = set(lost)
        packets = []
        for i in range(x_mv.size // per_packet):
            t_s = (i + 1) * per_packet / rate
            if i not in gone:
                values = x_mv[i * per_packet : (i + 1) * per_packet].round(6).tolist()
                packets.append(
                    {
                        "Header": header(i, t_s, 2 * per_packet),
                        "PacketGenTime": START_MS + round(1000 * t_s) if gen else -62135568000000,
                        "PacketRxUnixTime": START_MS + round(1000 * t_s) + 40,
                        "ChannelSamples": [{"Key": 0, "Value": values}],
                        "DebugInfo": 0,
                        "EvokedMarker": [],
                        "IncludedChannels": 1,
                        "SampleRate": RATE_CODES[rate],
                        "Units": "millivolts",
                    }
                )
        return [{"RecordInfo": info(), "TimeDomainData": packets}]

    def settings(self, enabled: tuple[int, ...] = (0,), sense: int = 1) -> list[Any]:
        programs = [
            {"isEnabled": 0 if p in enabled else 131, "amplitudeInMilliamps": 8.5, "pulseWidthInMicroseconds": 60} for p in range(4)
        ]
        channel = {"plusInput": 4, "minusInput": 1, "sampleRate": 1}
        off = {"plusInput": 8, "minusInput": 1, "sampleRate": 240}
        return [
            {
                "RecordInfo": info(START_MS - 5000),
                "UtcOffset": -7,
                "GeneralData": {
                    "therapyStatusData": {"activeGroup": 0, "therapyStatus": 1},
                    "deviceSerialNumber": [ord(c) for c in SERIAL],
                },
                "SubjectInfo": {"ID": "Ada Lovelace", "ClinicianNotes": "lives in Ockham", "TargetCoordinates": [{"x": float("nan")}]},
                "SensingConfig": {
                    "timeDomainChannels": [channel, off, off, off],
                    "fftConfig": {"interval": 100, "size": 1},
                    "powerChannels": [{"band0Start": 10, "band0Stop": 11, "band1Start": 7, "band1Stop": 11}] * 4,
                },
                "SenseState": {"state": sense},
                "TherapyConfigGroup0": {"rateInHz": 130.2, "programs": programs},
                "AmplitudeLimitsGroup0": {"prog0LowerInMilliamps": 0, "prog0UpperInMilliamps": 3.5},
            }
        ]

    def stim(self, *steps: tuple[float, dict[str, Any]]) -> list[Any]:
        """Build records of (seconds after the start, delta)."""
        return [{"RecordInfo": info(START_MS + 1000 * t), **delta} for t, delta in steps]

    def program(self, amplitude: float, program: int = 0) -> dict[str, Any]:
        return {"TherapyConfigGroup0": {f"program{program}": {"AmplitudeInMilliamps": amplitude}}}

    def note(self, t_s: float, text: str, swapped: bool = False) -> dict[str, Any]:
        ms = START_MS + int(1000 * t_s)
        fields = {"EventType": "08_15_2019 12:33:20 PM", "EventSubType": text} if swapped else {"EventType": text, "EventSubType": ""}
        return {"RecordInfo": info(ms), "Event": {"EventName": "UserCustom", **fields, "UnixOnsetTime": ms, "UnixOffsetTime": ms}}


PERCEPT_RATE = 250
PERCEPT_TICK = 310_250
PERCEPT_TIME = "2024-03-14T10:05:52.000Z"


class Percept:
    """Small Percept session reports in the spellings that real ones have."""

    first_tick = PERCEPT_TICK

    def time_domain(
        self, channel: str, samples: np.ndarray, first_tick: int = PERCEPT_TICK, lost: tuple[int, ...] = (), spelling: str = "comma"
    ) -> dict[str, Any]:
        """Build packets of 125 samples every 500 ms; the packets numbered in `lost` are missing."""
        count = samples.size // 125
        kept = [k for k in range(count) if k not in lost]
        lists = {
            "GlobalSequences": [(3 * k + 1) // 2 % 256 for k in kept],
            "GlobalPacketSizes": [125] * len(kept),
            "TicksInMses": [first_tick + 500 * k for k in kept],
        }
        write = {
            "comma": lambda values: ",".join(map(str, values)) + ",",
            "bracket": lambda values: str(values),
            "list": lambda values: values,
        }[spelling]
        return {
            "Pass": "",
            **{name: write(values) for name, values in lists.items()},
            "Channel": channel,
            "Gain": 227,
            "FirstPacketDateTime": PERCEPT_TIME,
            "SampleRateInHz": PERCEPT_RATE,
            "TimeDomainData": np.concatenate([samples[125 * k : 125 * (k + 1)] for k in kept]).round(6).tolist(),
        }

    def power(
        self,
        channel: str,
        values: int,
        first_tick: int = PERCEPT_TICK,
        when: str = PERCEPT_TIME,
        left_ma: float = 0.0,
        right_ma: float = 2.0,
    ) -> dict[str, Any]:
        """Build the device's power at 2 Hz: 100, 101, … on the sensed sides, and constant amplitudes."""
        sensed = {side: side.upper() in channel for side in ("Left", "Right")}
        rows = [
            {
                "Seq": 2 + k,
                "TicksInMs": first_tick + 500 * k,
                "StatusBytes": "00 00 00 00",
                "Left": {"LFP": (100 + k) * sensed["Left"], "mA": left_ma},
                "Right": {"LFP": (100 + k) * sensed["Right"], "mA": right_ma},
            }
            for k in range(values)
        ]
        limits = {"LowerLimitInMilliAmps": 0.5, "UpperLimitInMilliAmps": 3.5, "FrequencyInHertz": 20.51, "RateInHertz": 125}
        return {
            "Channel": channel,
            "FirstPacketDateTime": when,
            "SampleRateInHz": 2,
            "TherapySnapshot": {"ActiveGroup": "GroupIdDef.GROUP_B", **{side: limits for side, on in sensed.items() if on}},
            "LfpData": rows,
        }

    def sine(self, seconds: float, hz: float = 20.0, amplitude: float = 3.0) -> np.ndarray:
        return amplitude * np.sin(2 * np.pi * hz * np.arange(int(seconds * PERCEPT_RATE)) / PERCEPT_RATE)

    def report(self, **sections: Any) -> dict[str, Any]:
        """Build a whole report with identity in every corner where devices put it."""
        return {
            "AbnormalEnd": False,
            "SessionDate": "2022-12-16T17:28:33Z",
            "ProgrammerTimezone": "Pacific/Ockham",
            "ProgrammerUtcOffset": "+01:00",
            "PatientInformation": {"Final": {"PatientFirstName": "Ada", "PatientLastName": "Lovelace", "PatientId": "MRN4711"}},
            "DeviceInformation": {
                "Final": {
                    "Neurostimulator": "Percept PC",
                    "NeurostimulatorSerialNumber": "NPX799999H",
                    "ImplantDate": "2020-02-20T00:00:00Z",
                    "DeviceName": "Ada's device",
                    "DeviceDateTime": "2024-03-14T09:51:07Z",
                },
                "Initial": {"DeviceDateTime": "2024-03-14T09:51:07Z"},
            },
            "LeadConfiguration": {"Final": [{"Hemisphere": "HemisphereLocationDef.Right", "LeadSerialNumber": "LEAD4711"}]},
            **sections,
        }

    def one_run(self, channel: str = "ONE_THREE_RIGHT", seconds: float = 20.0, **kwargs: Any) -> dict[str, Any]:
        """Build a report of one run of one channel with a sine."""
        domain = self.time_domain(channel, self.sine(seconds), **kwargs)
        return self.report(BrainSenseTimeDomain=[domain], BrainSenseLfp=[self.power(channel, int(2 * seconds) - 1)])


@pytest.fixture
def percept() -> Percept:
    return Percept()


@pytest.fixture
def rcs() -> Rcs:
    return Rcs()


@pytest.fixture
def pack(tmp_path: Path) -> Callable[..., Path]:
    """Zip files given as text, bytes or JSON values; names are those inside the archive."""

    def make(files: dict[str, Any], name: str = "session.zip") -> Path:
        path = tmp_path / name
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for inner, content in files.items():
                archive.writestr(inner, content if isinstance(content, str | bytes) else json.dumps(content))
        return path

    return make


@pytest.fixture
def same_recording() -> Callable[[Any, Any], bool]:
    """Asserts that two recordings are equal in everything but the device's name, field by field; True when they are."""

    def check(first: Any, second: Any) -> bool:
        for field in dataclasses.fields(first):
            a, b = getattr(first, field.name), getattr(second, field.name)
            if field.name in ("traces", "spectra"):
                assert len(a) == len(b)
                assert all(x.same_as(y) for x, y in zip(a, b, strict=True)), field.name
            elif field.name != "device_key":
                assert a == b, field.name
        return True

    return check
