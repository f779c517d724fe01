"""Events of an RC+S recording: stimulation steps, changes of the adaptive state, operator's notes and where they disagree."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.formats.dose import stimulating
from ml.formats.rcs.amplitude import AmplitudeSteps
from ml.formats.rcs.labels import parse, render
from ml.formats.rcs.packets.streams import Adaptive
from ml.formats.rcs.packets.time import PacketTimes
from ml.formats.rcs.settings import GROUPS, Settings, dose_of, get, integer, number
from ml.formats.rcs.traces import Grid
from ml.formats.recording import EventLog

AMPLITUDE_TOLERANCE_MA = 0.05
MAX_NOTES = 10_000
CASE = 16
"""Index of the case among the electrodes of a program; 0 to 15 are contacts. Source: format notes, A.5."""


def stimulation_events(settings: Settings, grid: Grid) -> list[EventLog]:
    """List every state of the stimulation log that differs from the one before: therapy on or off, amplitude, rate, pulse width."""
    out = []
    for t_ms, state in zip(settings.therapy.times_ms, settings.therapy.states, strict=True):
        programs = []
        for p in stimulating(state.programs):
            program = state.programs[p]
            contacts = _contacts(settings, state.group, p)
            set_to = {"amplitude_ma": program.amplitude_ma, "pulse_width_us": program.pulse_width_us, "contacts": contacts}
            programs.append({"program": p, **set_to})
        dose = dose_of(state)
        total = dose.amplitude_ma
        known = all(np.isfinite(total))
        data: dict[str, Any] = {
            "therapy_on": state.on,
            "group": None if state.group is None else GROUPS[state.group],
            "rate_hz": state.rate_hz,
            "programs": programs,
            "delivered_ma": [round(a, 4) for a in total] if known else None,
            "why": list(dose.why),
            "origin": "StimLog" if settings.stim_log else "DeviceSettings",
        }
        amplitudes = " + ".join("? mA" if p["amplitude_ma"] is None else f"{p['amplitude_ma']:g} mA" for p in programs)
        label = (
            "therapy off" if state.on is False else "therapy unknown" if state.on is None else f"therapy on, {amplitudes or 'no program'}"
        )
        out.append(EventLog(_t_s(t_ms, grid), "stimulation", label, data))
    return out


def _contacts(settings: Settings, group: int | None, program: int) -> str:
    """List stimulating contacts with their signs, such as `-2 +C` (C: the case); empty where the settings lack them."""
    electrodes = get(settings.merged, f"TherapyConfigGroup{group}", "programs", program, "electrodes", "electrodes")
    signs = {0: "-", 1: "+"}
    used = [
        f"{signs[kind]}{'C' if i == CASE else i}"
        for i, e in enumerate(electrodes if isinstance(electrodes, list) else ())
        if get(e, "isOff") is False and (kind := integer(get(e, "electrodeType"))) in signs
    ]
    return " ".join(sorted(used, key=lambda name: name[0] == "+"))


def adaptive_events(data: Adaptive, times: PacketTimes, grid: Grid) -> list[EventLog]:
    """List changes of the adaptive state; the first state is the first event."""
    placed = np.flatnonzero(np.isfinite(times.last_ms))
    states = data.state[placed]
    changed = placed[np.flatnonzero(np.diff(states, prepend=states[0] - 1 if states.size else 0))]
    return [
        EventLog(_t_s(float(times.last_ms[i]), grid), "adaptive_state", f"adaptive state {data.state[i]}", {"state": int(data.state[i])})
        for i in changed
    ]


def note_events(
    records: list[Any], steps: AmplitudeSteps, grid: Grid, of_pc_ms: Callable[[NDArray[np.float64]], NDArray[np.float64]]
) -> list[EventLog]:
    """List operator's notes by the grammar of labels. `conflict` is true where the noted amplitude is not the device's at that time.

    `of_pc_ms` brings the notes' PC times onto the recording's timeline.
    """
    out = []
    for record in records[:MAX_NOTES]:
        event = get(record, "Event")
        t_ms = number(get(event, "UnixOnsetTime")) or number(get(record, "RecordInfo", "HostUnixTime"))
        if t_ms is None or not 0 < t_ms < 2.5e14:
            continue
        t_ms = float(of_pc_ms(np.array([t_ms]))[0])
        found = parse(get(event, "EventType"), get(event, "EventSubType"), get(event, "EventName"))
        if "amplitude_ma" in found:
            device = _amplitude_at(steps, t_ms)
            found["device_amplitude_ma"] = device
            found["conflict"] = None if device is None else abs(device - found["amplitude_ma"]) > AMPLITUDE_TOLERANCE_MA
        out.append(EventLog(_t_s(t_ms, grid), "operator_note", render(found), found))
    return out


def _amplitude_at(steps: AmplitudeSteps, t_ms: float) -> float | None:
    """Find the amplitude of the program that stimulates, mA; the largest when there are several, None when unknown."""
    i = int(np.searchsorted(steps.t_ms, t_ms, side="right")) - 1
    if i < 0 or not steps.programs:
        return None
    value = float(np.max(steps.amplitude_ma[i, list(steps.programs)]))
    return round(value, 4) if np.isfinite(value) else None


def _t_s(t_ms: float, grid: Grid) -> float:
    return round((t_ms - grid.start_ms) / 1000.0, 4)
