"""Details of a Percept report other than its streams: therapy groups and their history, trends, snapshots, events, battery, in plain
values.

Nothing in here quotes free text of the report. Enumerations are reduced to known shapes. Names that a person may have typed (groups,
events) are reduced to known words or numbers. So a redacted report gives the same details as the original.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from datetime import datetime
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.formats.facts.sentinels import reading, readings
from ml.formats.percept.annotations import Annotation
from ml.formats.percept.enums import UNKNOWN, mask, word
from ml.formats.percept.facts import (
    AMPLITUDE,
    AVERAGING,
    BAND,
    BATTERY_MONTHS,
    BATTERY_PERCENT,
    IMPEDANCE,
    MAGNITUDE,
    POWER,
    PULSE_WIDTH,
    RATE,
)
from ml.formats.percept.keys import KEYS
from ml.formats.percept.report_json import SIDES, entries, finite, inside, moment, samples, side_of
from ml.formats.percept.words import EVENT_WORDS, cleaned
from ml.formats.recording import EventLog

ToUtc = Callable[[datetime], datetime]
"""Converts a date of the report, on the implant's clock, to UTC."""

MAX_EVENTS = 5_000


def event_label(entry: dict[str, Any]) -> str:
    """Name a patient's event by its known word, else by its number: `event 3`."""
    name = entry.get("EventName")
    if isinstance(name, str) and name.strip().lower() in EVENT_WORDS:
        return name.strip().lower()
    number = finite(entry.get("EventID", entry.get("EventId")))
    return "event" if number is None else f"event {number:g}"


def groups(value: Any) -> list[dict[str, Any]]:
    """List therapy groups: programs and sensing per side."""
    out = []
    for group in entries(value):
        settings = group.get("ProgramSettings")
        rate = reading(finite(inside(settings, "RateInHertz")), RATE)
        sensing = [_sensing(s) for s in entries(inside(settings, "SensingChannel"))]
        programs = [
            _program(program, side, rate)
            for side in SIDES
            for program in entries(inside(settings, f"{side.capitalize()}Hemisphere", "Programs"))
        ]
        programs += [
            _program(s, named, rate) for s in entries(inside(settings, "SensingChannel")) if (named := side_of(s.get("HemisphereLocation")))
        ]
        letter = _letter(group.get("GroupId"))
        if letter is None and not programs and not sensing:
            continue  # an entry of which nothing is understood is no group
        out.append(
            {
                "group": letter,
                "active": group.get("ActiveGroup") is True,
                "programs": programs,
                "sensing": sensing,
            }
        )
    return out


def _letter(value: Any) -> str | None:
    """Extract `A` of `GroupIdDef.GROUP_A`."""
    named = word(value)
    return named.removeprefix("GROUP_") if named else None


def _program(program: dict[str, Any], side: str, rate_hz: float | None) -> dict[str, Any]:
    own = reading(finite(program.get("RateInHertz")), RATE)
    return {
        "side": side,
        "amplitude_ma": _amplitude(program),
        "lower_ma": reading(finite(program.get("LowerLimitInMilliAmps")), AMPLITUDE),
        "upper_ma": reading(finite(program.get("UpperLimitInMilliAmps")), AMPLITUDE),
        "rate_hz": rate_hz if own is None else own,
        "pulse_width_us": reading(finite(program.get("PulseWidthInMicroSecond")), PULSE_WIDTH),
        "contacts": contacts(program.get("ElectrodeState")),
    }


def _amplitude(program: dict[str, Any]) -> float | None:
    """Read a program's amplitude in mA; of a lead whose segments have amplitudes of their own (SenSight) the sum over its cathodes.

    None where one of them lacks its own.
    """
    whole = reading(finite(program.get("AmplitudeInMilliAmps")), AMPLITUDE)
    if whole is not None:
        return whole
    cathodes = [e for e in entries(program.get("ElectrodeState")) if word(e.get("ElectrodeStateResult")) == "Negative"]
    known = [own for e in cathodes if (own := reading(finite(e.get("ElectrodeAmplitudeInMilliAmps")), AMPLITUDE)) is not None]
    return round(sum(known), 3) if known and len(known) == len(cathodes) else None


def contacts(value: Any) -> str:
    """List electrodes in use with their sign: `-SenSight_1a +Case`."""
    signs = {"Negative": "-", "Positive": "+"}
    named = ((word(e.get("Electrode")), signs.get(word(e.get("ElectrodeStateResult")) or "")) for e in entries(value))
    return " ".join(f"{sign}{name}" for name, sign in named if name and sign)


def _sensing(sensing: dict[str, Any]) -> dict[str, Any]:
    return {
        "side": side_of(sensing.get("HemisphereLocation")),
        "channel": word(sensing.get("Channel")),
        "frequency_hz": reading(finite(inside(sensing, "SensingSetup", "FrequencyInHertz")), BAND),
        "averaging_ms": reading(finite(inside(sensing, "SensingSetup", "AveragingDurationInMilliSeconds")), AVERAGING),
        "lower_threshold": reading(finite(sensing.get("LowerLfpThreshold")), POWER),
        "upper_threshold": reading(finite(sensing.get("UpperLfpThreshold")), POWER),
        "suspend_amplitude_ma": reading(finite(sensing.get("SuspendAmplitudeInMilliAmps")), AMPLITUDE),
        "status": word(sensing.get("BrainSensingStatus")),
        "adaptive": word(sensing.get("AdaptiveTherapyStatus")),
    }


def snapshot(value: dict[str, Any], side: str) -> dict[str, Any]:
    """Read therapy and sensing of one side as they were set when a run began (TherapySnapshot)."""
    own = inside(value, side.capitalize())
    return {
        "group": _letter(value.get("ActiveGroup")),
        "high_pass_hz": reading(finite(value.get("HighPassFilterInHertz")), BAND),
        "sensing_frequency_hz": reading(finite(inside(own, "FrequencyInHertz")), BAND),
        "rate_hz": reading(finite(inside(own, "RateInHertz")), RATE),
        "pulse_width_us": reading(finite(inside(own, "PulseWidthInMicroSecond")), PULSE_WIDTH),
        "averaging_ms": reading(finite(inside(own, "AveragingDurationInMilliSeconds")), AVERAGING),
        "lower_threshold": reading(finite(inside(own, "LowerLfpThreshold")), POWER),
        "upper_threshold": reading(finite(inside(own, "UpperLfpThreshold")), POWER),
        "contacts": contacts(inside(own, "ElectrodeState")),
    }


def limits(value: dict[str, Any], side: str) -> dict[str, Any]:
    """Read the clinician's amplitude limits of one side, mA, in the shape of `RecordingLog.limits`."""
    own = inside(value, side.capitalize())
    low, high = (reading(finite(inside(own, f"{end}LimitInMilliAmps")), AMPLITUDE) for end in ("Lower", "Upper"))
    if low is None or high is None:
        return {}
    return {f"group {_letter(value.get('ActiveGroup')) or '?'}": {side: {"lower_ma": low, "upper_ma": high}}}


def group_history(value: Any, utc: ToUtc) -> list[dict[str, Any]]:
    """List therapy groups at earlier visits, oldest first. The key of the date is `SessionDate` or `Sessiondate`."""
    dated = []
    for entry in entries(value):
        when = moment(entry.get("SessionDate", entry.get("Sessiondate")))
        dated.append({"at": _iso(when, utc), "groups": groups(entry.get("Groups", entry.get("Settings")))})
    return sorted(dated, key=lambda d: str(d["at"] or ""))


def trends(value: Any, utc: ToUtc) -> tuple[dict[str, Any], int]:
    """Read averages over 10 minutes by side: times, power in device units, amplitude in mA. They are sorted; of equal times the newest read
    counts. Also count the values that are no readings."""
    out: dict[str, Any] = {}
    void = 0
    for hemisphere, blocks in value.items() if isinstance(value, dict) else ():
        side = side_of(word(hemisphere) or hemisphere)
        if side is None:
            continue
        reads = sorted(blocks.items()) if isinstance(blocks, dict) else [("", blocks)]
        by_time: dict[datetime, tuple[float | None, float | None]] = {}
        for _, rows in reads:
            for row in entries(rows):
                if (when := moment(row.get("DateTime"))) is not None:
                    by_time[when] = finite(row.get("LFP")), finite(row.get("AmplitudeInMilliAmps"))
        times = sorted(by_time)
        if times:
            power = [reading(by_time[t][0], POWER) for t in times]
            amplitude = [reading(by_time[t][1], AMPLITUDE) for t in times]
            void += sum(
                kept is None and by_time[t][i] is not None
                for i, row in enumerate((power, amplitude))
                for t, kept in zip(times, row, strict=True)
            )
            out[side] = {"unix_s": [utc(t).timestamp() for t in times], "power_device_units": power, "amplitude_ma": amplitude}
    return out, void


def snapshot_events(value: Any, utc: ToUtc) -> list[dict[str, Any]]:
    """List spectra that the device stored when the patient marked an event. Events may promise a spectrum (`LFP: true`) and have none."""
    out = []
    for entry in entries(value)[:MAX_EVENTS]:
        spectra = {}
        held = entry.get("LfpFrequencySnapshotEvents")
        for hemisphere, data in held.items() if isinstance(held, dict) else ():
            side = side_of(word(hemisphere) or hemisphere)
            hz, bins = samples(inside(data, "Frequency")), samples(inside(data, "FFTBinData"))
            if side and 0 < hz.size == bins.size <= 1000:
                spectra[side] = {"hz": hz.tolist(), "magnitude": _magnitudes(bins), "group": _letter(inside(data, "GroupId"))}
        out.append({"at": _iso(moment(entry.get("DateTime")), utc), "label": event_label(entry), "spectra": spectra})
    return out


def _magnitudes(values: NDArray[np.float64]) -> list[float | None]:
    """List magnitudes, None where there is no reading."""
    return [None if np.isnan(v) else float(v) for v in readings(values, MAGNITUDE)[0]]


def montage(value: Any) -> list[dict[str, Any]]:
    """List the device's own spectra of a survey (LFPMontage): magnitude in uVp, as the programmer shows it."""
    out = []
    for entry in entries(value)[:200]:
        hz = samples(entry.get("LFPFrequency", entry.get("LFPFrequencyinHertz")))
        magnitude = samples(entry.get("LFPMagnitude", entry.get("LFPMagnitudeinMicroVoltPeak")))
        if 0 < hz.size == magnitude.size <= 1000:
            said = {
                "side": side_of(word(entry.get("Hemisphere"))),
                "channel": word(entry.get("SensingElectrodes")),
                "artifact": word(entry.get("ArtifactStatus")),
                "peak_hz": reading(finite(entry.get("PeakFrequencyInHertz")), BAND),
            }
            out.append({**said, "hz": hz.tolist(), "magnitude": _magnitudes(magnitude)})
    return out


def battery(report: dict[str, Any]) -> dict[str, Any]:
    """Read the state of the battery, without its telemetry codes."""
    state = report.get("BatteryInformation")
    return {
        "percent": reading(finite(inside(state, "BatteryPercentage")), BATTERY_PERCENT),
        "months_left": reading(finite(inside(state, "EstimatedBatteryLifeMonths")), BATTERY_MONTHS),
        "status": word(inside(state, "BatteryStatus")),
    }


def impedance(value: Any) -> list[dict[str, Any]]:
    """List impedances by side in ohm, with the state of the test."""
    out = []
    for test in entries(value):
        for half in entries(test.get("Hemisphere")):
            measured = inside(half, "SessionImpedance")
            pairs = [*entries(inside(measured, "Monopolar")), *entries(inside(measured, "Bipolar"))]
            named = [
                [word(p.get("Electrode1")), word(p.get("Electrode2")), reading(finite(p.get("ResultValue")), IMPEDANCE)]
                for p in pairs[:200]
            ]
            out.append({"side": side_of(word(half.get("Hemisphere"))), "ohm": named, "status": word(test.get("ImpedanceStatus"))})
    return out


DatedEvent = tuple[datetime, str, str, dict[str, Any]]
"""Time, kind (`device`, `patient`, `annotation`, `rating`), label, data."""


def dated_events(report: dict[str, Any], utc: ToUtc, annotations: Iterable[Annotation] = ()) -> list[DatedEvent]:
    """List the device's event log, the patient's events and the annotations, in UTC and in time order."""
    out: list[DatedEvent] = [_event_of(a, utc) for a in annotations]
    for entry in _log_entries(report):
        when = moment(entry.get("DateTime", entry.get("EventDateTime")))
        if when is None:
            continue
        if "EventName" in entry or "EventID" in entry or "EventId" in entry:
            out.append((utc(when), "patient", event_label(entry), {}))
            continue
        said = {k if k in KEYS else cleaned(k): named for k, v in entry.items() if (named := word(v))}
        out.append((utc(when), "device", _log_label(said), said))
    when = moment(inside(report, "DeviceInformation", "Initial", "DeviceDateTime"))
    for state in dict.fromkeys(filter(None, (word(t.get("ImpedanceStatus")) for t in entries(report.get("Impedance"))))):
        if when is not None:
            out.append((utc(when), "device", f"impedance {state.lower()}", {"ImpedanceStatus": state}))
    return sorted(out, key=lambda e: e[0])[-MAX_EVENTS:]


_LABELS = {
    "RechargeSessionType": "recharge",
    "TherapyStatus": "therapy",
    "AdaptiveTherapyStatus": "adaptive therapy",
    "SensingStatus": "sensing",
    "SessionType": "session",
}
_STATES = {"SessionStart": "started", "SessionEnd": "ended"}


def _log_label(states: dict[str, str]) -> str:
    """Name an entry of the event log; a key that is not in `_LABELS` keeps its technical name."""
    left = {k: v for k, v in states.items() if k != "ParameterTrendId"}
    parts = []
    groups = [(left.pop(k, "") or "?").removeprefix("GROUP_") for k in ("OldGroupId", "NewGroupId")] if "NewGroupId" in left else []
    if groups:
        parts.append(f"active group {groups[0]} to {groups[1]}")
    for key, state in left.items():
        name = _LABELS.get(key) or (cleaned(key) if key in KEYS else key)
        parts.append(f"{name} {_STATES.get(state) or (state.lower() if key in _LABELS else state)}")
    return ", ".join(parts) or states.get("ParameterTrendId") or "log entry"


def unknown_names(report: dict[str, Any]) -> list[str]:
    """List enumerations and keys of the device's log, impedance and leads that have a word which is unknown."""
    out: dict[str, None] = {}
    held = [*_log_entries(report), *entries(report.get("Impedance"))]
    for part in ("Initial", "Final"):
        held += entries(inside(report, "LeadConfiguration", part))
    for entry in held:
        for key, value in entry.items():
            shown = mask(value) if isinstance(value, str) and len(value) <= 102 else None
            if shown and key != "EventName" and (UNKNOWN in shown or key not in KEYS):
                out[f"{cleaned(key)}: {shown}"] = None
    return list(out)


def _event_of(a: Annotation, utc: ToUtc) -> DatedEvent:
    if a.value is None:
        return utc(a.at), "annotation", a.label, {"under": a.under}
    return utc(a.at), "rating", a.label, {"under": a.under, "value": a.value}


def undated_events(report: dict[str, Any]) -> int:
    """Count entries of the patient's events without a time: the programmer lists there which events can be marked."""
    return sum(moment(e.get("DateTime", e.get("EventDateTime"))) is None for e in _patient_entries(report))


def _log_entries(report: dict[str, Any]) -> Iterable[dict[str, Any]]:
    yield from entries(inside(report, "DiagnosticData", "EventLogs"))
    yield from entries(inside(report, "DiagnosticData", "LfpFrequencySnapshotEvents"))
    yield from _patient_entries(report)


def _patient_entries(report: dict[str, Any]) -> Iterable[dict[str, Any]]:
    patient = report.get("PatientEvents")
    if isinstance(patient, dict) and not {"EventName", "DateTime"} & set(patient):
        for part in patient.values():
            yield from entries(part)
    else:
        yield from entries(patient)


def as_events(dated: Iterable[DatedEvent], origin: datetime) -> tuple[EventLog, ...]:
    """Convert the events to seconds after `origin`."""
    return tuple(EventLog(round((when - origin).total_seconds(), 3), kind, label, data) for when, kind, label, data in dated)


def _iso(when: datetime | None, utc: ToUtc) -> str | None:
    return utc(when).isoformat() if when else None
