"""A proposed session as a form: its values as text, and the typed text as a correction."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime, timedelta
from typing import Any

import numpy as np
from markupsafe import Markup
from numpy.typing import NDArray
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.ingest.proposals.visit_of_recording import VisitToAdd
from app.ingest.schemas import PartIn, ProposalChange
from app.ingest.wording import KIND_NAMES
from app.platform.errors import Invalid
from app.platform.numbers import counted
from app.platform.web.charts import written
from app.platform.web.forms import FieldNote, parse, same_value
from app.platform.web.svg import Plane, drawing
from app.study import blinding
from app.study import repository as study
from app.study.recordings.amplitude_sources import AmplitudeConflictOut
from app.study.sessions.usable_steps import SessionData, UsableSteps
from app.tables.sessions import SessionSegment, StudySession
from app.tables.uploads import SessionProposal

LABELS = {
    "visit": "Visit", "controller": "Controller", "policy": "Policy", "hemisphere": "Hemisphere", "from": "From", "to": "To",
    "control": "Control channel", "program": "Program", "started_at": "Start", "start_s": "From", "stop_s": "To",
}  # fmt: skip
FIELDS = {"start_s": "from", "stop_s": "to", "control_stream": "control", "control_channel": "control", "control_program": "program"}
"""What the form calls the fields of a correction, where it calls them otherwise."""
_PART_LABELS = {"start_s": "Begin", "stop_s": "End", "controller": "Controller"}

HIDDEN = "hidden"
"""Replaces a controller that is stated and must stay hidden; sent back, it changes nothing."""
PARTS = 6
"""Rows of the form that cuts a recording; longer days are cut twice, or over the interface."""


@dataclass(frozen=True)
class ProposalForm:
    """A proposal as its page shows it.

    Attributes:
        stored, typed: field to text, as stored and as the form shows it.
        clocked: whether times are dates and times of day; else minutes and seconds of the recording.
        why: by field, why it is proposed so.
        notes: contradictions that a person should look at.
        drawn: how the amplitudes of a random session were drawn; empty for other sessions.
        usable: usable steps by channel, the control channel first.
        programs: that the control recording has an amplitude of.
        thumbnail: beta and amplitude at a glance, None where neither is known or they must stay hidden.
        problem: why the form was refused. remarks: its parts, by field; `part-2` is a row of the form that cuts, `parts` all.
        markers: whether its recordings have markers that a lab may explain. asked: how many leave amplitudes unknown.
        to_add: the visit that can be made of the recording.
        conflicts: where sources of the amplitude differ.
        clock: what its times rest on, where they can be corrected; else empty. clock_unknown: whether its offset from UTC is unknown.
        own: what was typed into the forms of amplitude and clock, by field.
    """

    session: StudySession
    proposal: SessionProposal
    stored: Mapping[str, str]
    typed: Mapping[str, str]
    parts: list[dict[str, str]]
    clocked: bool
    why: Mapping[str, str]
    notes: list[str]
    drawn: str
    usable: list[UsableSteps]
    programs: list[int]
    thumbnail: Markup | None = None
    reason: str = ""
    problem: dict[str, Any] | None = None
    remarks: Mapping[str, FieldNote] = field(default_factory=dict)
    to_add: VisitToAdd | None = None
    markers: bool = False
    asked: int = 0
    conflicts: Sequence[AmplitudeConflictOut] = ()
    clock: str = ""
    clock_unknown: bool = False
    own: Mapping[str, str] = field(default_factory=dict)

    @property
    def sources(self) -> list[str]:
        """Names of the sources of the amplitude that differ."""
        return list(dict.fromkeys(name for c in self.conflicts for name in c.sources))

    @property
    def seen(self) -> str:
        """Stored values for the form to send back. They separate an old form's own corrections from what others changed."""
        return json.dumps(dict(self.stored))

    @property
    def control(self) -> SessionSegment:
        """The part of the recording that the controller saw."""
        return next(s for s in self.session.segments if s.is_control)

    @property
    def source(self) -> str:
        """Names of its files in words that distinguish files of one name: their numbers, device, sides and control channel."""
        recordings = [s.recording for s in self.session.segments]
        files = sorted({r.upload_file_id for r in recordings if r.upload_file_id is not None})
        kinds = dict.fromkeys(KIND_NAMES.get(r.device.kind, r.device.kind) for r in recordings)
        sides = dict.fromkeys(r.hemisphere for r in recordings if r.hemisphere)
        channel = f"{self.session.control_stream.replace('_', ' ')} {written(self.session.control_channel or '')}".strip()
        named = [f"file{'s' if len(files) != 1 else ''} {', '.join(map(str, files))}"] if files else []
        return ", ".join([*named, *kinds, " and ".join(sides), channel]).replace(", , ", ", ")

    @property
    def complete(self) -> bool:
        """True where nothing is open."""
        return bool(self.typed["visit"] and self.typed["controller"])


def texts(db: Session, session: StudySession, proposal: SessionProposal, caller: Caller) -> dict[str, str]:
    """Format the values of a proposal as text."""
    arm = blinding.visible_arm(session, caller)
    hidden = arm is None and blinding.is_stated(session)
    control = next(s for s in session.segments if s.is_control)
    return {
        "visit": "" if proposal.visit_open else str(session.visit.number),
        "controller": HIDDEN if hidden else arm.controller.value if arm else "",
        "policy": study.policy_name(db, arm.policy_id if arm else None) or "",
        "hemisphere": session.hemisphere or "",
        "control": f"{session.control_stream}|{session.control_channel or ''}",
        "program": "" if session.control_program is None else str(session.control_program),
        "from": _time(session, control.start_s),
        "to": _time(session, control.stop_s),
        "started_at": _clock(session.started_at) if session.started_at else "",
    }


def typed_texts(values: Mapping[str, Any], session_id: int, stored: Mapping[str, str]) -> dict[str, str]:
    """Read what the form sent for a proposal; a field that it does not have is as stored."""
    return {name: str(values.get(f"{name}-{session_id}", text)).strip() for name, text in stored.items()}


def own_texts(values: Mapping[str, Any], session_id: int, stored: Mapping[str, str]) -> dict[str, str]:
    """Find what a person changed in the form of a proposal. It was sent, differs from what the form had shown, and is not stored by now."""
    try:
        seen = json.loads(str(values.get(f"seen-{session_id}", "{}")))
    except ValueError:
        seen = {}
    shown = {**stored, **seen} if isinstance(seen, dict) else stored
    typed = typed_texts(values, session_id, stored)
    return {n: text for n, text in typed.items() if not (same_value(text, str(shown[n])) or same_value(text, stored[n]))}


def typed_parts(values: Mapping[str, Any], session_id: int) -> list[dict[str, str]]:
    """Read the rows of the form that cuts a recording, filled in or not."""
    names = ("from", "to", "controller")
    return [{name: str(values.get(f"part-{session_id}-{i}-{name}", "")).strip() for name in names} for i in range(PARTS)]


OWN = {"ahead_s": "Ahead of UTC", "uncertainty_s": "Within", "clock_reason": "Reason", "source": "Source", "source_reason": "Reason"}
"""Fields of the forms of clock and amplitude, which have buttons of their own."""


def typed_own(values: Mapping[str, Any], session_id: int) -> dict[str, str]:
    """Read what the form sent of clock and amplitude of a proposal."""
    return {name: str(values.get(f"{name}-{session_id}", "")).strip() for name in OWN}


def as_change(session: StudySession, version: str, stored: Mapping[str, str], typed: Mapping[str, str]) -> ProposalChange:
    """Convert the fields that a person changed to a correction. Raises Invalid, naming the field."""
    own = {name: text for name, text in typed.items() if not same_value(text, stored[name])}
    fields: dict[str, Any] = {n: own[n] for n in ("visit", "controller", "policy", "hemisphere", "started_at") if n in own}
    if "visit" in own and not own["visit"]:
        del fields["visit"]  # an open visit stays open
    if own.get("control"):
        fields["control_stream"], _, fields["control_channel"] = own["control"].partition("|")
    if own.get("program"):
        fields["control_program"] = own["program"]
    errors = []
    for name, target in (("from", "start_s"), ("to", "stop_s")):
        if name in own:
            try:
                fields[target] = f"{_seconds(session, own[name]):.3f}"
            except ValueError as error:
                errors.append({"where": LABELS[name], "what": str(error), "name": name})
    if errors:
        raise Invalid("Some times cannot be used.", "Correct them and send the form again.", errors=errors)
    return parse(ProposalChange, {"version": version, **fields}, LABELS, FIELDS)


def as_parts(session: StudySession, rows: list[dict[str, str]]) -> list[PartIn]:
    """Convert the filled rows to parts of the recording. Raises Invalid, naming the row."""
    parts, errors = [], []
    for i, row in enumerate(rows, start=1):
        if not row["from"] and not row["to"]:
            continue
        try:
            start, stop = _seconds(session, row["from"]), _seconds(session, row["to"])
            fields = {"start_s": f"{start:.3f}", "stop_s": f"{stop:.3f}", "controller": row["controller"]}
            parts.append(parse(PartIn, fields, _PART_LABELS))
        except ValueError as error:
            errors.append({"where": f"row {i}", "what": str(error), "name": f"part-{i}"})
        except Invalid as error:
            what = "; ".join(f"{e['where']}: {e['what']}" for e in error.extra["errors"])
            errors.append({"where": f"row {i}", "what": what, "name": f"part-{i}"})
    if errors:
        raise Invalid("Some parts cannot be used.", "Correct them and send the form again.", errors=errors)
    if not parts:
        raise Invalid("No part is filled in.", "Give at least one begin and end.")
    return parts


def _time(session: StudySession, offset_s: float) -> str:
    """Format a place in the control recording as the form shows it."""
    begin = _begin(session)
    if begin is not None:
        return _clock(begin + timedelta(seconds=offset_s))
    minutes, seconds = divmod(round(offset_s), 60)
    return f"{minutes}:{seconds:02d}"


def _seconds(session: StudySession, text: str) -> float:
    """Parse a place in the control recording, s, from what the form sent. Raises ValueError."""
    begin = _begin(session)
    if begin is not None:
        try:
            moment = datetime.fromisoformat(text)
        except ValueError:
            raise ValueError(f"'{text}' is no date and time (as in {_clock(begin)})") from None
        seconds = (moment.replace(tzinfo=moment.tzinfo or UTC) - begin).total_seconds()
        if seconds < -1:
            raise ValueError(f"{text} is before the recording, which begins at {_clock(begin)} UTC")
        return max(seconds, 0.0)
    minutes, colon, seconds_text = text.partition(":")
    try:
        found = 60 * int(minutes) + float(seconds_text) if colon else float(text)
    except ValueError:
        raise ValueError(f"'{text}' is no time (minutes:seconds from the begin of the recording, as in 12:30)") from None
    if not 0 <= found < 1e7:
        raise ValueError(f"'{text}' does not lie in the recording")
    return found


def _begin(session: StudySession) -> datetime | None:
    """Find when the control recording began, by the session's own clock; None for a recording without one."""
    control = next(s for s in session.segments if s.is_control)
    if control.recording.started_at is None or session.started_at is None:
        return None
    return session.started_at - timedelta(seconds=control.start_s)


def _clock(moment: datetime) -> str:
    return moment.astimezone(UTC).replace(tzinfo=None).isoformat(timespec="seconds")


def is_clocked(session: StudySession) -> bool:
    """Decide whether the form shows dates and times of day."""
    return _begin(session) is not None


W, LEFT, TOP, EACH, BETWEEN, BOTTOM = 520.0, 44.0, 22.0, 48.0, 44.0, 38.0


def thumbnail(data: SessionData) -> Markup | None:
    """Draw the steps of a session; None where neither beta nor an amplitude is known. Missing steps stay gaps."""
    table = data.table
    inside = table.t_s > 0
    minutes = table.t_s[inside] / 60
    known_ma = bool(np.any(~np.isnan(table.amplitude_ma[inside])))
    amplitude = table.amplitude_ma[inside] if known_ma else 100 * table.fraction[inside]
    unit = written(table.beta_trace.unit) if table.beta_trace else ""
    strips = [(table.beta[inside], f"Beta ({unit})", "accent"), (amplitude, f"Amplitude ({'mA' if known_ma else '% of cDBS'})", "text")]
    shown = [s for s in strips if np.any(~np.isnan(s[0]))]
    if not shown:
        return None
    titles = [""] * (len(shown) - 1) + ["Time (min)"]
    planes = [_strip(minutes, *strip, titles[k], TOP + k * (EACH + BETWEEN)) for k, strip in enumerate(shown)]
    height = TOP + len(shown) * (EACH + BETWEEN) - BETWEEN + BOTTOM
    words = " and ".join(title for _, title, _ in shown)
    return drawing(W, height, f"{words} over {counted(round(float(minutes[-1])), 'minute')}", "Gaps are steps without a value.", planes)


def _strip(minutes: NDArray[np.float64], values: NDArray[Any], title: str, colour: str, below: str, top: float) -> Plane:
    highest = float(np.nanquantile(values, 0.98)) or 1.0
    plane = Plane(LEFT, top, W - LEFT - 8, EACH, (0.0, float(minutes[-1])), (min(0.0, float(np.nanmin(values))), 1.1 * highest))
    plane.axes(below, title, x_ticks=6, y_ticks=2)
    plane.line(_points(minutes, values), colour, 1.2, step=colour == "text")
    return plane


def _points(minutes: NDArray[np.float64], values: NDArray[Any]) -> Sequence[tuple[float, float | None]]:
    return [(t, None if np.isnan(v) else float(v)) for t, v in zip(minutes.tolist(), values.tolist(), strict=True)]
