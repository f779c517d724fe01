"""Writes a real RC+S session folder: eleven JSON files as the Summit device leaves them, from simulated sessions.

A recording holds one or several sessions of a visit. Streams run from the first beta window before a session to its end and pause between
sessions, when cDBS runs. Every control step that changes the amplitude is a record of StimLog at its PC time; a no-DBS session switches the
therapy off. Packet counters of 8 bits, the 16 bit tick of 100 us and an implant clock of its own roll over as they do on the device.
"""

from __future__ import annotations

import heapq
import io
import json
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ml.population.device import settings as ds
from ml.population.participants import PARTICIPANTS, ParticipantModel
from ml.population.physiology.brain import LFP_RATE_HZ, SAMPLES_PER_PERIOD
from ml.population.sessions import SimulatedSession

Json = dict[str, Any]

INS_EPOCH_UNIX: Final = 951_868_800
"""2000-03-01 00:00, where the implant's seconds begin."""
NO_GEN_TIME: Final = -62_135_568_000_000
STREAM_START_MS: Final = 5_000
"""From the start of the recording to the first stream."""
_API = "1.6.0.0"
_GEN_JITTER_MS, _LATENCY_MS, _LATENCY_TAIL_MS, _LATENCY_MAX_MS = 8.0, 30, 15.0, 200.0
_LOSS_BURST_PACKETS = 2.0
_TIME_SYNC_MS = 1_000
_STREAM_KEYS = {"RawDataTD": "TimeDomainData", "RawDataPower": "PowerDomainData", "TimeSync": "TimeSyncData"}
_UNUSED_STREAMS = {"RawDataAccel": "AccelData", "RawDataFFT": "FftData"}


@dataclass(frozen=True)
class _Block:
    """One session on the PC clock: streams from `stream_ms`, step 0 from `start_ms`, end at `end_ms`."""

    session: SimulatedSession
    stream_ms: int
    start_ms: int
    end_ms: int


def rcs_session_zip(
    sessions: SimulatedSession | Sequence[SimulatedSession],
    *,
    started_ms: int,
    serial: str = "SYN000001H",
    packet_loss: float = 0.0,
    seed: int = 0,
    gap_s: float = 60.0,
    ins_clock_offset_s: float = 0.0,
    bad_gen_times: int = 3,
) -> bytes:
    """Write a recording as the bytes of a ZIP with `Session<unix ms>/Device<serial>/` and its eleven files; equal arguments give equal
    bytes.

    Args:
        sessions: of one participant, in the order they took place, each with its LFP. Their amplitudes are logged in steps of 0.1 mA, the
            device's resolution; run them with `resolution_ma=0.1` so that the log equals the amplitudes exactly.
        started_ms: PC time of the recording's start, unix ms; the first stream starts 5 s later.
        serial: ten characters.
        packet_loss: share of time-domain and power packets that never arrive, 0 to below 1, in bursts of two on average.
        seed: of loss and jitter. gap_s: pause between sessions, s.
        ins_clock_offset_s: how far the implant's clock is ahead of the PC's; years are usual.
        bad_gen_times: packets at the start of each stream without a valid generation time.

    Raises:
        ValueError: no session, several participants, a session without LFP, a serial of another length or a loss outside [0, 1).
    """
    listed = [sessions] if isinstance(sessions, SimulatedSession) else list(sessions)
    _check(listed, serial, packet_loss, gap_s)
    participant = PARTICIPANTS[listed[0].participant]
    blocks = list(_layout(listed, started_ms, gap_s))
    info = {"ApiVer": _API, "DeviceId": serial, "HostUnixTime": started_ms, "SessionId": str(started_ms)}
    clock_ms = round(1000 * ins_clock_offset_s) - 1000 * INS_EPOCH_UNIX
    streams = _Streams(np.random.default_rng(seed), clock_ms, packet_loss, bad_gen_times)
    for block in blocks:
        streams.record(block)
    begun = info | {"HostUnixTime": started_ms + 3_000}
    files: dict[str, Any] = {name: [{"RecordInfo": begun, key: streams.packets[name]}] for name, key in _STREAM_KEYS.items()}
    files |= {name: [{"RecordInfo": begun, key: []}] for name, key in _UNUSED_STREAMS.items()}
    files["AdaptiveLog"] = []
    files["ErrorLog"] = []
    files["DiagnosticsLog"] = _with_times(info, [(started_ms + 2_500, _latency_test())])
    files["DeviceSettings"] = _with_times(info, _settings_records(participant, serial, blocks, started_ms, clock_ms))
    files["StimLog"] = _with_times(info, stim_records(participant, blocks, started_ms))
    files["EventLog"] = _with_times(info, _event_records(blocks))
    return _zip(f"Session{started_ms}/Device{serial}", files)


def stim_records(participant: ParticipantModel, blocks: Sequence[_Block], started_ms: int) -> list[tuple[int, Json]]:
    """Make the delta records of StimLog with their PC times: all groups first, then each change of amplitude or therapy status."""
    amplitude = participant.cdbs_amplitude_ma
    first: Json = {"therapyStatusData": {"activeGroup": 0, "therapyStatus": 1}}
    first |= {f"TherapyConfigGroup{n}": ds.stim_group(participant, n, amplitude) for n in range(4)}
    records: list[tuple[int, Json]] = [(started_ms + 1_500, first)]
    tenths = round(10 * amplitude)
    for block in blocks:
        off = block.session.controller == "no_dbs"
        if off:
            records.append((block.start_ms, {"therapyStatusData": {"therapyStatus": 0}}))
        else:
            for k, fraction in enumerate([*block.session.amplitude, 1.0]):
                wanted = round(10 * fraction * amplitude)
                if wanted != tenths:
                    tenths = wanted
                    change = {"TherapyConfigGroup0": {"program0": ds.stim_amplitude(tenths / 10)}}
                    records.append((block.start_ms + 2_000 * k, change))
        if off:
            records.append((block.end_ms, {"therapyStatusData": {"therapyStatus": 1}}))
        reread = {"TherapyConfigGroup0": ds.stim_group(participant, 0, tenths / 10)}
        records += [(block.end_ms + 400, {"therapyStatusData": {"activeGroup": 0}}), (block.end_ms + 900, reread)]
    return records


class _Streams:
    """Packets of time domain, power and time sync in the order the device made them, with counters that run on over losses."""

    def __init__(self, rng: np.random.Generator, clock_ms: int, loss: float, bad_gen_times: int) -> None:
        self.packets: dict[str, list[Json]] = {name: [] for name in _STREAM_KEYS}
        self._rng, self._clock_ms, self._loss, self._bad = rng, clock_ms, loss, bad_gen_times
        self._sequence = {name: int(rng.integers(256)) for name in _STREAM_KEYS}
        self._global = int(rng.integers(256))
        self._losing = False

    def record(self, block: _Block) -> None:
        """Stream one session."""
        lfp = block.session.lfp
        assert lfp is not None  # checked on entry
        counts = np.rint(lfp.astype(np.float64) * ds.GAIN * ds.COUNTS_PER_VOLT / 1200.0)
        seen = dict.fromkeys(_STREAM_KEYS, 0)
        for last_ms, name, body in heapq.merge(
            _time_domain(counts, block.stream_ms), _power(counts, block.stream_ms), _time_sync(block), key=lambda entry: entry[0]
        ):
            header, lost = self._header(name, last_ms, body.pop("header")), self._lost(name)
            gen = round(last_ms + min(max(self._rng.normal(0, _GEN_JITTER_MS), -50), 50))
            delay = min(_LATENCY_MS + self._rng.exponential(_LATENCY_TAIL_MS), _LATENCY_MAX_MS)
            packet = {
                "Header": header,
                "PacketGenTime": gen if seen[name] >= self._bad else NO_GEN_TIME,
                "PacketRxUnixTime": round(gen + delay),
                **body,
            }
            seen[name] += 1
            if not lost:
                self.packets[name].append(packet)

    def _header(self, name: str, last_ms: int, own: Json) -> Json:
        self._sequence[name] = (self._sequence[name] + 1) % 256
        self._global = (self._global + 1) % 256
        ins_ms = last_ms + self._clock_ms
        return {
            "dataSize": own["dataSize"],
            "dataType": own["dataType"],
            "dataTypeSequence": self._sequence[name],
            "globalSequence": self._global,
            "info": own["info"],
            "systemTick": (10 * ins_ms) % 65536,
            "timestamp": {"seconds": ins_ms // 1000},
            "user1": own["user1"],
            "user2": own["user2"],
        }

    def _lost(self, name: str) -> bool:
        if name == "TimeSync" or self._loss == 0:
            return False
        stop = 1 / _LOSS_BURST_PACKETS
        start = min(1.0, stop * self._loss / (1 - self._loss))
        self._losing = bool(self._rng.random() < ((1 - stop) if self._losing else start))
        return self._losing


def _time_domain(counts: NDArray[np.float64], stream_ms: int) -> Iterator[tuple[int, str, Json]]:
    n = ds.PACKET_SAMPLES
    values = counts * (1200.0 / (ds.GAIN * ds.COUNTS_PER_VOLT))
    for i in range(0, values.size, n):
        part = np.round(values[i : i + n], 6).tolist()
        header = {"dataSize": 2 * len(part), "dataType": 1, "info": 1, "user1": ds.RATE_CODE, "user2": 1}
        body = {
            "header": header,
            "ChannelSamples": [{"Key": 0, "Value": part}],
            "DebugInfo": 1,
            "EvokedMarker": [],
            "IncludedChannels": 1,
            "SampleRate": ds.RATE_CODE,
            "Units": "millivolts",
        }
        yield stream_ms + (i + len(part)) * 1000 // LFP_RATE_HZ, "RawDataTD", body


def _power(counts: NDArray[np.float64], stream_ms: int) -> Iterator[tuple[int, str, Json]]:
    hop = ds.FFT_INTERVAL_MS * LFP_RATE_HZ // 1000
    for end in range(ds.FFT_SAMPLES, counts.size + 1, hop):
        bands = [*band_power(counts[end - ds.FFT_SAMPLES : end]), 0, 0, 0, 0, 0, 0]
        header = {"dataSize": 32, "dataType": 32, "info": 0, "user1": ds.FFT_SIZE_CODE << 4 | ds.RATE_CODE, "user2": ds.VALID_MASK}
        body = {
            "header": header,
            "Bands": bands,
            "ExternalValuesMask": 0,
            "FftSize": ds.FFT_SIZE_CODE,
            "IsPowerChannelOverrange": False,
            "SampleRate": ds.RATE_CODE,
            "ValidDataMask": ds.VALID_MASK,
        }
        yield stream_ms + end * 1000 // LFP_RATE_HZ, "RawDataPower", body


def band_power(counts: NDArray[np.float64]) -> list[int]:
    """Compute the on-device power of the two bands from one FFT window of device units, [250]: 64 |FFT|^2 / N^2 per bin, shifted,
    summed."""
    spectrum = np.fft.rfft(counts * np.hanning(counts.size), n=ds.FFT_SIZE)
    power = 64.0 * np.abs(spectrum) ** 2 / ds.FFT_SIZE**2
    shifted = np.floor(power / 2 ** (8 - (15 - ds.BAND_FORMATION)))
    return [int(shifted[low : high + 1].sum()) for low, high in ds.POWER_BANDS]


def _time_sync(block: _Block) -> Iterator[tuple[int, str, Json]]:
    for t in range(block.stream_ms + _TIME_SYNC_MS // 2, block.end_ms, _TIME_SYNC_MS):
        header = {"dataSize": 0, "dataType": 240, "info": 0, "user1": 0, "user2": 0}
        yield t, "TimeSync", {"header": header, "LatencyMilliseconds": float(_LATENCY_MS)}


def _layout(sessions: list[SimulatedSession], started_ms: int, gap_s: float) -> Iterator[_Block]:
    t = started_ms + STREAM_START_MS
    for session in sessions:
        start = t + 2_000 * session.lead_beta.size
        end = start + 2_000 * session.steps
        yield _Block(session, t, start, end)
        t = end + round(1000 * gap_s)


def _settings_records(
    participant: ParticipantModel, serial: str, blocks: Sequence[_Block], started_ms: int, clock_ms: int
) -> list[tuple[int, Json]]:
    def seconds(t: int) -> int:
        return (t + clock_ms) // 1000

    records = [(started_ms + 500, ds.device_settings(participant, serial, seconds(started_ms)))]
    for block in blocks:
        records.append((block.stream_ms - 300, {"TherapyConfigGroup0": ds.therapy_group(participant, 0, participant.cdbs_amplitude_ma)}))
        records.append((block.stream_ms - 100, {"StreamState": ds.stream_state(on=True)}))
        if block.session.controller == "no_dbs":
            records.append((block.start_ms + 50, {"GeneralData": ds.general_data(serial, seconds(block.start_ms), therapy_on=False)}))
        records.append((block.end_ms + 50, {"GeneralData": ds.general_data(serial, seconds(block.end_ms), therapy_on=True)}))
        records.append((block.end_ms + 200, {"StreamState": ds.stream_state(on=False)}))
    return records


def _event_records(blocks: Sequence[_Block]) -> list[tuple[int, Json]]:
    """Make notes at the start, the grasp test and the end of each session; they do not reveal the controller."""
    records = []
    for number, block in enumerate(blocks, start=1):
        grasp_ms = max(block.start_ms, block.end_ms - 10_000)
        for t, text in ((block.start_ms, "Start session"), (grasp_ms, "Grasp test of session"), (block.end_ms, "Stop session")):
            local = datetime.fromtimestamp(t / 1000, UTC).strftime("%m_%d_%Y %I:%M:%S %p")
            event = {"EventName": "UserCustom", "EventSubType": local, "EventType": f"{text} {number}"}
            records.append((t, {"Event": event | {"UnixOffsetTime": t, "UnixOnsetTime": t}}))
    return records


def _latency_test() -> Json:
    result = {"AverageLatency": float(_LATENCY_MS), "DiagnosticType": "LatencyTestEvent", "TestPacketNum": 10, "Units": "milliseconds"}
    return {"LatencyResultsDiagnostic": result}


def _with_times(info: Json, records: list[tuple[int, Json]]) -> list[Json]:
    return [{"RecordInfo": info | {"HostUnixTime": t}, **body} for t, body in sorted(records, key=lambda record: record[0])]


def _zip(folder: str, files: dict[str, Any]) -> bytes:
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in sorted(files.items()):
            entry = zipfile.ZipInfo(f"{folder}/{name}.json", date_time=(2020, 1, 1, 0, 0, 0))
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, json.dumps(content, separators=(",", ":")))
    return sink.getvalue()


def _check(sessions: list[SimulatedSession], serial: str, packet_loss: float, gap_s: float) -> None:
    if not sessions:
        raise ValueError("a recording needs at least one session")
    if len({session.participant for session in sessions}) > 1:
        raise ValueError("a recording belongs to one participant; these sessions belong to several")
    for session in sessions:
        if session.lfp is None or session.lfp.size != (session.lead_beta.size + session.steps) * SAMPLES_PER_PERIOD:
            raise ValueError(f"the session with seed {session.seed} has no LFP; simulate it with keep_lfp=True")
    if len(serial) != 10 or not serial.isascii() or not serial.isalnum():
        raise ValueError(f"a device serial has ten letters or digits, not {serial!r}")
    if not 0 <= packet_loss < 1:
        raise ValueError(f"packet loss must lie in [0, 1), not {packet_loss}")
    if gap_s < 2:
        raise ValueError(f"sessions need a pause of at least 2 s between them, not {gap_s} s")
