"""Choice of the channel that a controller saw, by lead, contacts and what it can teach; and of the program that it set."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from enum import StrEnum

import numpy as np

from app.study.sessions.stimulation import SILENT_MA
from app.study.sessions.usable_steps import CONTROL_STREAMS, Worth, worth_of
from app.study.traces import AMPLITUDE_STREAM, amplitude_program, unpack
from app.tables.participants import Hemisphere, SettingsVersion
from app.tables.recordings import Recording, Trace

STIMULATED = ("STN", "GPi")
"""Targets whose beta follows the stimulation of Parkinson's disease; other deep targets come after them."""
CORTEX = ("M1", "S1", "PMC", "SMA", "PFC", "OFC", "ACC")
_PAIR = re.compile(r"\+(\d+)-(\d+)")
SURVEY_MONTAGES = 3
"""So many sets of sensing contacts within one recording are a survey of montages: a controller keeps the one it was trained on."""


LITTLE = 0.5
"""A channel with less than this share of the usable steps of another channel of its target is not taken for its contacts."""


@dataclass(frozen=True)
class Place:
    """Place where a channel was measured.

    Attributes:
        lead: side and target as the device's settings have them, such as `left STN`; empty where they lack them.
        contacts: plus and minus; None where they are not known. shorted: both are the same contact, so that there is no signal.
    """

    lead: str
    contacts: tuple[int, int] | None

    @property
    def shorted(self) -> bool:
        """True where the pair is one contact twice."""
        return self.contacts is not None and self.contacts[0] == self.contacts[1]

    @property
    def target(self) -> str:
        """`STN` of `left STN`; empty where it is not known."""
        words = self.lead.split()
        return words[-1] if words and words[-1] not in ("left", "right") else ""


def place_of(trace: Trace, recording: Recording) -> Place:
    """Find where the channel of a trace was measured, by the recording's settings."""
    key = trace.details.get("channel_key")
    if key is None and (named := re.match(r"key (\d)", trace.channel)):
        key = int(named[1])
    settings = recording.details.get("settings") or {}
    leads = [str(x or "") for x in settings.get("leads") or []]
    bore = leads[2 * (int(key) // 2) : 2 * (int(key) // 2) + 2] if key is not None else leads
    named_leads = {lead for lead in bore if lead}
    pair = _PAIR.search(trace.channel) or _PAIR.search(_contacts_of_key(settings, key))
    return Place(named_leads.pop() if len(named_leads) == 1 else "", (int(pair[1]), int(pair[2])) if pair else None)


def _contacts_of_key(settings: dict[str, object], key: int | None) -> str:
    """Return the contacts of a sensing key where they never changed; empty otherwise."""
    sensing = settings.get("sensing")
    rows = sensing if isinstance(sensing, list) else []
    pairs = {str(s["contacts"][key]) for s in rows if key is not None and len(s.get("contacts") or []) > key}
    return pairs.pop() if len(pairs) == 1 else ""


def of_part(
    traces: Sequence[Trace], recording: Recording, settings: SettingsVersion, part_s: tuple[float, float], side: Hemisphere | None
) -> Trace | None:
    """Choose the channel that a controller is taken to have seen in a part of a recording: of the participant's source where there is one.

    Args:
        traces: of the recording.
        settings: of the participant.
        part_s: begin and end within the recording, s.
        side: the stated one; None: the recording's own.
    """
    candidates = [t for stream in CONTROL_STREAMS for t in traces if t.stream == stream and any(t.valid_bits)]
    wanted = [t for t in candidates if t.source == settings.beta_source] or [t for t in candidates if t.stream == candidates[0].stream]
    return choose(wanted, recording, side or recording.hemisphere, lambda trace: worth_of(trace, settings, *part_s))


def choose(candidates: Sequence[Trace], recording: Recording, side: Hemisphere | None, worth: Callable[[Trace], Worth]) -> Trace | None:
    """Choose the channel that a controller is taken to have seen, of those of one kind.

    A pair of one contact with itself and the other side are excluded. A deep target comes before an unknown one, and that before cortex. Of
    one target those that teach little (`LITTLE`) come last. Then a pair around the stimulating contact comes before one next to it, and
    that before one with it. Of equals the one with the most usable steps wins, then the most valid ones, then the first.
    """
    cathodes = _cathodes(recording)
    places = {id(trace): place_of(trace, recording) for trace in candidates}
    worths = {id(trace): worth(trace) for trace in candidates}

    def target(trace: Trace) -> tuple[bool, bool, int]:
        place = places[id(trace)]
        other_side = side is not None and place.lead.split()[:1] in (["left"], ["right"]) and place.lead.split()[0] != side
        return place.shorted, other_side, _of_target(place.target)

    best = min(map(target, candidates), default=None)
    of_target = [trace for trace in candidates if target(trace) == best]
    most = max((worths[id(trace)].usable for trace in of_target), default=0)

    def rank(trace: Trace) -> tuple[bool, int, int, int]:
        own = worths[id(trace)]
        return own.usable < LITTLE * most, _of_contacts(places[id(trace)], cathodes), -own.usable, -own.valid

    return min(of_target, key=rank, default=None)


def _of_target(target: str) -> int:
    if target in STIMULATED:
        return 0
    return 2 if not target else 3 if target in CORTEX else 1


def _of_contacts(place: Place, cathodes: frozenset[int]) -> int:
    """Rank a pair by the stimulating contacts. 0: they are between the pair; 1: next to it, or unknown; 2: the pair has one of them, and
    its artefact."""
    if place.contacts is None or not cathodes:
        return 1
    low, high = sorted(place.contacts)
    if cathodes & {low, high}:
        return 2
    return 0 if all(low < c < high for c in cathodes) else 1


def _cathodes(recording: Recording) -> frozenset[int]:
    """List the numbers of the contacts that stimulate, as far as the recording's stimulation log has them."""
    programs = [
        p
        for e in recording.details.get("events") or []
        if e.get("kind") == "stimulation" and (e.get("data") or {}).get("therapy_on")
        for p in e["data"].get("programs") or []
        if p.get("amplitude_ma")
    ]
    return frozenset(int(c) for p in programs for c in re.findall(r"-(\d+)", str(p.get("contacts") or "")))


def montages(recording: Recording) -> int:
    """Count the sets of sensing contacts that a recording went through, without those that were replaced before it began."""
    states = (recording.details.get("settings") or {}).get("sensing") or []
    begun = [i for i, s in enumerate(states) if float(s.get("from_s") or 0.0) <= 0.0]
    inside = [s for s in states[begun[-1] if begun else 0 :] if float(s.get("from_s") or 0.0) < recording.duration_s]
    return len({tuple(s.get("contacts") or ()) for s in inside})


def is_survey(recording: Recording) -> bool:
    """Decide whether a recording is a survey of sensing montages, in which no controller was at work."""
    return montages(recording) >= SURVEY_MONTAGES


class How(StrEnum):
    """Course of the amplitude of a program."""

    MOVED = "moved"
    CONSTANT = "constant"
    OFF = "off"
    UNKNOWN = "unknown"


ORDER = list(How)
"""A controller moves its program's amplitude; where none moved, one that stimulated is more than one that was off."""


@dataclass(frozen=True)
class Program:
    """One program of a recording, and how its amplitude ran; `low`, `high` of the known values, NaN without any."""

    number: int
    how: How
    low: float
    high: float


def programs_of_part(traces: Sequence[Trace], start_s: float, stop_s: float) -> list[Program]:
    """List every program of a recording within a part of it (s), the one that a controller is taken to have set first."""
    found = [_program(t, start_s, stop_s) for t in traces if t.stream == AMPLITUDE_STREAM]
    return sorted(found, key=lambda p: (ORDER.index(p.how), -np.nan_to_num(p.high - p.low), -np.nan_to_num(p.high), p.number))


def _program(trace: Trace, start_s: float, stop_s: float) -> Program:
    ends = trace.first_end_s + trace.dt_s * np.arange(trace.n)
    values = unpack(trace)[(ends > start_s) & (ends <= stop_s + trace.dt_s / 2)]
    known = values[~np.isnan(values)]
    if not known.size:
        return Program(amplitude_program(trace), How.UNKNOWN, np.nan, np.nan)
    low, high = float(known.min()), float(known.max())
    how = How.OFF if high <= SILENT_MA else How.MOVED if high - low > SILENT_MA else How.CONSTANT
    return Program(amplitude_program(trace), how, low, high)
