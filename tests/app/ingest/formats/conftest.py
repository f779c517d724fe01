from __future__ import annotations

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
    """Header of packet number `index` whose last sample is t_s after the start."""
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
        """Records of (seconds after the start, delta)."""
        return [{"RecordInfo": info(START_MS + 1000 * t), **delta} for t, delta in steps]

    def program(self, amplitude: float, program: int = 0) -> dict[str, Any]:
        return {"TherapyConfigGroup0": {f"program{program}": {"AmplitudeInMilliamps": amplitude}}}

    def note(self, t_s: float, text: str, swapped: bool = False) -> dict[str, Any]:
        ms = START_MS + int(1000 * t_s)
        fields = {"EventType": "08_15_2019 12:33:20 PM", "EventSubType": text} if swapped else {"EventType": text, "EventSubType": ""}
        return {"RecordInfo": info(ms), "Event": {"EventName": "UserCustom", **fields, "UnixOnsetTime": ms, "UnixOffsetTime": ms}}


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
