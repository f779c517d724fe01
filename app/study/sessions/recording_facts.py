"""What a recording says of itself besides its traces: data quality per stream, the clinician's amplitude limits, its clock."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from app.study.models import Recording

CLOCKS = {
    "pc": "clock of the PC that recorded (packet times)",
    "device": "clock of the device, which may be off the clock of the wall",
    "table": "times of the table",
}

_TWICE = "the same packet twice"
_BACK = "PacketGenTime steps back"
_KNOWN = {"packets", "samples", "missing", "missing_samples", "loss", "chunks", "rejected", "unusable", "clock", "loss_visible", "rate_hz"}


@dataclass(frozen=True)
class StreamQuality:
    """One stream of a recording; None where its file does not tell.

    Attributes:
        name: of the stream. what: whether `count` and `missing` are packets or samples.
        loss: share missing, 0 to 1. gaps: interruptions. back_steps, duplicates: left out for these reasons.
        clock: what placed it in time. remarks: everything else, in words.
    """

    name: str
    what: str
    count: int | None
    missing: int | None
    loss: float | None
    gaps: int | None
    back_steps: int
    duplicates: int
    clock: str
    remarks: list[str]


def quality_rows(recording: Recording) -> list[StreamQuality]:
    """Data quality of each stream, in the order of the decoder."""
    rows = []
    for name, told in recording.details.get("quality", {}).items():
        if not isinstance(told, Mapping) or name == "valid_fraction" or not _is_stream(told):
            continue
        if _KNOWN & told.keys():
            rows.append(_row(name, told, recording.clock))
        else:
            rows += [_row(f"{name} {channel}", one, recording.clock) for channel, one in told.items()]
    return rows


def quality_remarks(recording: Recording) -> list[str]:
    """What the quality says that belongs to no stream, in words."""
    quality = recording.details.get("quality", {})
    return [
        f"{_words(name)}: {_plain(value)}"
        for name, value in quality.items()
        if value not in (None, {}) and name != "valid_fraction" and not (isinstance(value, Mapping) and _is_stream(value))
    ]


@dataclass(frozen=True)
class SensingConfiguration:
    """What the device sensed from a moment of the recording on.

    Attributes:
        from_s: in the recording's seconds. channels: contacts and sampling rate of each channel. bands: of its own power, where on.
    """

    from_s: float
    channels: list[str]
    bands: list[str]


def sensing_configurations(recording: Recording) -> list[SensingConfiguration]:
    """Sensing as it changed within the recording; what only repeats the one before is left out."""
    found: list[SensingConfiguration] = []
    for state in recording.details.get("settings", {}).get("sensing") or []:
        contacts = state.get("contacts") or []
        rates = state.get("rates_hz") or []
        pairs = zip(contacts, rates, strict=False)
        channels = [f"key {i}: {pair} at {rate:g} Hz" for i, (pair, rate) in enumerate(pairs) if isinstance(rate, int | float)]
        bands = [str(b) for b in state.get("bands") or [] if b] if int(state.get("sense_bits") or 0) & 4 else []
        one = SensingConfiguration(float(state.get("from_s") or 0.0), channels, bands)
        if not found or (found[-1].channels, found[-1].bands) != (channels, bands):
            found.append(one)
    # what was set before the recording's begin and replaced before it says nothing of it
    return [c for i, c in enumerate(found) if i + 1 == len(found) or found[i + 1].from_s > 0]


def adaptive_states(recording: Recording) -> list[tuple[float, int]]:
    """Changes of the adaptive state: time in the recording (s), state."""
    events = recording.details.get("events") or []
    return [(float(e["t_s"]), int(e["data"]["state"])) for e in events if e.get("kind") == "adaptive_state"]


def leads(recording: Recording) -> str:
    """Where the leads are, as the device's settings say."""
    return ", ".join(str(x) for x in recording.details.get("settings", {}).get("leads") or [] if x)


def valid_shares(recording: Recording) -> dict[str, float]:
    """Share of valid windows per trace over the whole recording, 0 to 1."""
    told = recording.details.get("quality", {}).get("valid_fraction", {})
    return (
        {_words(name): float(value) for name, value in told.items() if isinstance(value, int | float)} if isinstance(told, Mapping) else {}
    )


def amplitude_limits(recording: Recording) -> list[tuple[str, str]]:
    """The clinician's limits that the device holds: where, and from to in mA."""
    found = []
    for group, programs in (recording.details.get("limits") or {}).items():
        for program, limit in _limit_rows(programs):
            found.append((" ".join(w for w in (_words(group), program) if w), limit))
    return found


def _is_stream(told: Mapping[str, Any]) -> bool:
    """Whether a part of the quality is a stream's, or has one of these per channel."""
    return bool(_KNOWN & told.keys()) or (bool(told) and all(isinstance(v, Mapping) and _KNOWN & v.keys() for v in told.values()))


def _limit_rows(told: Any) -> list[tuple[str, str]]:
    if not isinstance(told, Mapping):
        return [("", _plain(told))]
    if "lower_ma" in told or "upper_ma" in told:
        return [("", f"{_ma(told.get('lower_ma'))} to {_ma(told.get('upper_ma'))} mA")]
    return [(" ".join(w for w in (_words(k), tail) if w), limit) for k, v in told.items() for tail, limit in _limit_rows(v)]


def _row(name: str, told: Mapping[str, Any], clock: str) -> StreamQuality:
    samples = "packets" not in told and "samples" in told
    rejected = dict(told.get("rejected") or {})
    back, twice = int(rejected.pop(_BACK, 0)), int(rejected.pop(_TWICE, 0))
    remarks = [f"{count} left out: {why}" for why, count in rejected.items()]
    if told.get("unusable"):
        remarks.append(f"{told['unusable']} left out: fields missing or of the wrong kind")
    if told.get("loss_visible") is False:
        remarks.append("the file gives no packet times: loss cannot be seen")
    if told.get("rate_hz"):
        remarks.append(f"{_plain(told['rate_hz'])} Hz")
    remarks += [f"{_words(key)}: {_plain(value)}" for key, value in told.items() if key not in _KNOWN and value not in (None, {}, [])]
    unseen = told.get("loss_visible") is False
    return StreamQuality(
        _words(name),
        "samples" if samples else "packets",
        told.get("samples" if samples else "packets"),
        None if unseen else told.get("missing_samples" if samples else "missing"),
        None if unseen else told.get("loss"),
        max(0, int(told["chunks"]) - 1) if told.get("chunks") is not None else None,
        back,
        twice,
        str(told.get("clock", clock)),
        remarks,
    )


def _ma(value: Any) -> str:
    return f"{value:g}" if isinstance(value, int | float) else "?"


def _words(name: str) -> str:
    return str(name).replace("_", " ")


def _plain(value: Any) -> str:
    if isinstance(value, Mapping):
        return ", ".join(f"{_words(k)} {_plain(v)}" for k, v in value.items())
    if isinstance(value, list):
        return ", ".join(_plain(v) for v in value[:12]) + (" …" if len(value) > 12 else "")
    return f"{value:.4g}" if isinstance(value, float) else str(value)
