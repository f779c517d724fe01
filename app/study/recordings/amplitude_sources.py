"""Sources of a recording's amplitude that differ. The amplitude stays unknown until a person chooses a source, or `unknown`, with a reason.

The decoder stores what each source states with the recording (`ml.formats.disagreements`); the choice is stored there too.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from pydantic import Field
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.platform.database import set_reason
from app.platform.errors import Conflict, Invalid
from app.platform.numbers import ma, stated
from app.platform.web.schemas import Model, Text
from app.study import blinding
from app.study.access import require
from app.study.traces import AMPLITUDE_STREAM, pack, unpack
from app.tables.recordings import Recording, Trace
from app.tables.sessions import StudySession
from ml.formats.disagreements import CONFLICTS
from ml.signals import step_means

UNKNOWN = "unknown"
MOST_LEVELS = 6
CHOSEN = "chosen"
"""Member of a stored conflict: the choice."""


class AmplitudeChoice(Model):
    """Choice of a person among the sources of an amplitude that differ."""

    source: Text = Field(max_length=80, description="Name of a source, or `unknown`.")
    reason: Text = Field(min_length=1, max_length=1000, description="What the choice rests on.")


class AmplitudeConflictOut(Model):
    """A time in which two sources of the amplitude differ.

    Attributes:
        recording: number of it. from_s, to_s: of the recording.
        sources: by name, what it states, in words; empty while it must stay hidden.
        chosen: name of the chosen source, or `unknown`; None until one is chosen. by, reason: of the choice.
    """

    recording: int
    from_s: float
    to_s: float
    sources: dict[str, str]
    chosen: str | None
    by: str | None
    reason: str | None


@dataclass(frozen=True)
class AmplitudeConflict:
    """One stored conflict of a recording within a session."""

    recording: Recording
    stored: Mapping[str, Any]

    @property
    def open(self) -> bool:
        """True until one is chosen."""
        return CHOSEN not in self.stored

    def as_api(self, shown: bool) -> AmplitudeConflictOut:
        """Convert it for pages and interface; without what the sources state unless `shown`."""
        chosen = self.stored.get(CHOSEN) or {}
        return AmplitudeConflictOut(
            recording=self.recording.id,
            from_s=self.stored["from_s"],
            to_s=self.stored["to_s"],
            sources={name: _in_words(levels) if shown else "" for name, levels in self.stored["sources"].items()},
            chosen=chosen.get("source"),
            by=chosen.get("by"),
            reason=chosen.get("reason"),
        )


def of_session(session: StudySession) -> list[AmplitudeConflict]:
    """List the conflicts within the parts of recordings that a session has."""
    found = []
    for segment in session.segments:
        for one in _conflicts(segment.recording.details):
            if one["from_s"] < segment.stop_s and one["to_s"] > segment.start_s:
                found.append(AmplitudeConflict(segment.recording, one))
    return found


def refuse_open(session: StudySession) -> None:
    """Raise Conflict where sources of the session's amplitude differ and none was chosen."""
    if left := [c for c in of_session(session) if c.open]:
        names = " and ".join(dict.fromkeys(name for c in left for name in c.stored["sources"]))
        raise Conflict(
            f"Session {session.id} cannot be confirmed yet: {names} state different amplitudes in {_spans(left)}.",
            "Choose the source that is right, or 'unknown', with a reason.",
        )


def choose(db: Session, session: StudySession, choice: AmplitudeChoice, caller: Caller) -> list[AmplitudeConflictOut]:
    """Let one source count in all conflicts within a proposed session. Its rows of the amplitude change, and the trail keeps the choice.

    Raises:
        Conflict: the session is confirmed, whose amplitudes results rest on. Invalid: no conflict, or no source of that name.
    """
    require(caller, can.WRITE_STUDY, session.visit.participant)
    found = of_session(session)
    names = list(dict.fromkeys(name for c in found for name in c.stored["sources"]))
    if not found:
        raise Invalid(f"No two sources of the amplitude of session {session.id} differ.", "There is nothing to choose.")
    if choice.source not in (*names, UNKNOWN):
        hint = f"Choose one of {', '.join((*names, UNKNOWN))}."
        raise Invalid(f"'{choice.source}' is no source of the amplitude of session {session.id}.", hint, field="source")
    if session.status != "proposed":
        raise Conflict(f"Session {session.id} counts already, with the amplitude that it has.", "Exclude it with a reason instead.")
    if choice.source != UNKNOWN:
        blinding.require_known(session.visit, caller)  # who may not see what the sources state cannot judge them
    set_reason(db, f"amplitude by {choice.source}: {choice.reason}")
    made = {"source": choice.source, "by": caller.label, "reason": choice.reason}
    for recording in dict.fromkeys(c.recording for c in found):
        mine = [c.stored for c in found if c.recording is recording]
        after = [{**one, CHOSEN: made} if one in mine else dict(one) for one in _conflicts(recording.details)]
        recording.details = _replace_conflicts(recording.details, after)
        newest = max((t.decode_version for t in recording.traces), default=0)
        apply([t for t in recording.traces if t.decode_version == newest], [one for one in after if CHOSEN in one])
    db.flush()
    return [c.as_api(blinding.may_know(session.visit, caller)) for c in of_session(session)]


def keep_choice(old: Mapping[str, Any], fresh: dict[str, Any], traces: Sequence[Trace]) -> dict[str, Any]:
    """Keep the choices of a recording that is decoded again, for the conflicts that are the same.

    Args:
        old, fresh: details of the recording, as stored and as decoded. traces: the new ones, whose rows change.
    """
    made = {_key(one): one[CHOSEN] for one in _conflicts(old) if CHOSEN in one}
    after = [{**one, CHOSEN: made[_key(one)]} if _key(one) in made else dict(one) for one in _conflicts(fresh)]
    apply(traces, [one for one in after if CHOSEN in one])
    return _replace_conflicts(fresh, after) if after else fresh


def apply(traces: Sequence[Trace], conflicts: Sequence[Mapping[str, Any]]) -> None:
    """Write what the chosen sources state into the rows of the amplitude that lie wholly within the conflicts; all others stay."""
    for trace in traces:
        if trace.stream != AMPLITUDE_STREAM:
            continue
        values = unpack(trace)
        end_s = trace.first_end_s + trace.dt_s * np.arange(trace.n)
        for one in conflicts:
            inside = (end_s - trace.dt_s >= one["from_s"] - 1e-6) & (end_s <= one["to_s"] + 1e-6)
            values[inside] = _means(one["sources"].get(one[CHOSEN]["source"], {}).get(trace.channel, []), trace)[inside]
        trace.values_f32, trace.valid_bits = pack(values.astype(np.float32), ~np.isnan(values))
        if chosen := sorted({one[CHOSEN]["source"] for one in conflicts}):
            trace.details = {**trace.details, CHOSEN: chosen}


def _means(pieces: Sequence[Sequence[float]], trace: Trace) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Average what a source states over each row of a trace; NaN where it does not cover the row."""
    begin_s = trace.first_end_s - trace.dt_s
    knots = [(t - begin_s, value) for a, b, v in pieces for t, value in ((a, v), (b, np.nan))]
    last = dict(sorted(knots, key=lambda k: (k[0], not np.isnan(k[1]))))  # where one piece ends and another begins, the next one counts
    if not last:
        return np.full(trace.n, np.nan)
    t_s = np.array(sorted(last))
    means, covered = step_means(t_s, np.array([last[t] for t in t_s.tolist()]), float(t_s[-1]), trace.n, trace.dt_s)
    return np.where(covered > 1 - 1e-6, means, np.nan)


def _conflicts(details: Mapping[str, Any]) -> list[Mapping[str, Any]]:
    """List the conflicts of a recording's details; none in those of earlier decoders, which only counted them."""
    stored = details.get("quality", {}).get(CONFLICTS)
    return [one for one in stored if isinstance(one, Mapping) and "sources" in one] if isinstance(stored, list) else []


def _replace_conflicts(details: Mapping[str, Any], conflicts: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    return {**details, "quality": {**details["quality"], CONFLICTS: list(conflicts)}}


def _key(one: Mapping[str, Any]) -> tuple[Any, ...]:
    return one["from_s"], one["to_s"], repr(one["sources"])


def _spans(conflicts: Sequence[AmplitudeConflict]) -> str:
    several = f" and {len(conflicts) - 1} more" if len(conflicts) > 1 else ""
    one = conflicts[0].stored
    return f"{stated(one['from_s'], 4)} to {stated(one['to_s'], 4)} s of recording {conflicts[0].recording.id}{several}"


def _in_words(levels_of: Mapping[str, Sequence[Sequence[float]]]) -> str:
    """Describe what one source states, such as `program 0: 1.5 mA`; levels in their order."""
    told = []
    for channel, pieces in levels_of.items():
        levels = list(dict.fromkeys(f"{ma(v)} mA" for _, _, v in pieces))
        more = f" and {len(levels) - MOST_LEVELS} more" if len(levels) > MOST_LEVELS else ""
        told.append(f"{channel}: {', '.join(levels[:MOST_LEVELS]) or 'unknown'}{more}")
    return "; ".join(told) or "unknown"
