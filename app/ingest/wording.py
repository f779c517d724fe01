"""Sentences of uploads and proposals, made where they are shown; nothing is decided by them."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from app.ingest.evidence import Evidence, Reason, Source, stored_courses
from app.platform.errors import BetaloopError, DatabaseAway, GivenUp, StorageFull
from app.platform.numbers import ma
from app.study.sessions.stimulation import CDBS_TOLERANCE, Course, Pattern
from app.tables.recordings import Recording
from app.tables.uploads import ColumnMapping
from ml.formats import FILE_NAMES, OUTCOME_TABLES

_TELLING = ("controller", "program")
HIDDEN = "controller hidden"
SEALED = "hidden while the key of the blinded plan is sealed; kept as it is when the session is confirmed"


def reasons(evidence: Mapping[str, Any], sealed: bool = False) -> dict[str, str]:
    """Write the stored evidence of a proposal in words, by field; without what reveals what ran where the key of its plan is `sealed`."""
    said = {name: reason(Evidence.from_json(stored)) for name, stored in evidence.items()}
    return said | {name: SEALED for name in said if sealed and name in _TELLING}


def reason(evidence: Evidence) -> str:
    """Explain a value of a proposal."""
    return _stated(evidence) if evidence.reason is Reason.STATED else _SENTENCES[evidence.reason](evidence.facts)


KIND_NAMES = {
    **FILE_NAMES,
    "csv": "table",
    "parquet": "table (Parquet)",
    "control_log": "controller's log",
    **{one.kind: one.name for one in OUTCOME_TABLES},
    "mapped": "table with a column mapping",
    "unknown": "not read",
}
"""Kinds of files (`ml.formats.FileKind`, and `unknown` before a file is read) as people call them."""
WAITS = "cut short: read again by itself"
LEFT = "cut short: left as it is"
COMING = "being received"
"""By another web service, which alone knows how far it is."""
AFTER_READER_ENDED = (
    "It is kept encrypted. Send it again in smaller parts, or have BETALOOP_DECODE_MEMORY_MB or BETALOOP_DECODE_SECONDS raised and read it "
    "again on the page of the quarantine."
)


def reader_ended(cause: str, memory_mb: int, cpu_s: int | None) -> str:
    """Explain why a file could not be read, where a limit ended its reading."""
    reasons = {
        "memory": f"reading it takes more memory than the {memory_mb} MiB that one file may have",
        "time": f"reading it takes longer than the {cpu_s} s of processor time that one file may have",
    }
    return reasons.get(cause, "the process that read it was ended")


def progress(file: int, files: int, share: float, doing: str) -> str:
    """Describe how far the reading of an upload is."""
    of = f"file {file} of {files}: " if files > 1 else ""
    return f"{of}{doing}, {100 * share:.0f} %" if doing else f"{of}receiving"


def cut_short(upload_id: int, kept: int, of: int, beneath: BetaloopError | None = None) -> tuple[str, str]:
    """Describe what was kept of an upload that a fault ended, ours or one `beneath` the service that passes, and what follows."""
    what = f"Upload {upload_id} was cut short: the bytes of {kept} of its {of} file{'s' if of != 1 else ''} are kept."
    rest = "" if kept >= of else " Send the others again; what came before is recognised."
    if beneath is not None:
        what = f"{beneath.detail} {what}"
    if isinstance(beneath, StorageFull):
        when = "Ask your administrator to make room. What is kept is read by itself within some minutes of that"
    else:
        away = isinstance(beneath, DatabaseAway) and not isinstance(beneath, GivenUp)
        when = f"What is kept is read by itself within some minutes{' of its coming back' if away else ''}"
    return what, f"{when}: its report will be on /uploads/{upload_id}.{rest}"


def left(why: str) -> str:
    """Say that an upload which was cut short is not read, and why."""
    return f"This upload was cut short, and what is kept of it is left as it is. {why} It is read by itself if that is taken back."


MADE_ANEW = "What was kept of it was missing or damaged; these bytes took its place."


def read_by_mapping(mapping: ColumnMapping) -> str:
    """Say that a table was read by a column mapping of its study, and by which."""
    return f"read by the study's column mapping '{mapping.name}', version {mapping.version}"


def unreadable(members: list[str]) -> list[str]:
    """Describe files that could not be read, and are stored encrypted for that reason."""
    return [f"kept encrypted, because it could not be read: {member}" for member in members]


def _stated(evidence: Evidence) -> str:
    if evidence.source is Source.PERSON:
        return f"as stated by {evidence.facts['by']}{': open' if evidence.facts.get('open') else ''}"
    return "as stated with the upload" if evidence.source is Source.UPLOAD else "as stated when the recording was cut"


def _amplitude(facts: Mapping[str, Any]) -> str:
    courses = stored_courses(facts)
    if not courses:
        return _NO_AMPLITUDE
    if len(courses) == 1:
        return _course(courses[0])
    each = "; ".join(f"{c.side}: {_course(c)}" for c in courses)
    if len({c.controller for c in courses}) == 1:
        return each
    return f"the sides do not agree, so that a person must say which controller it was ({each})"


def _survey(facts: Mapping[str, Any]) -> str:
    return (
        f"recording {facts['recording']} is a survey of {facts['montages']} montages of sensing contacts, in which no controller was at "
        "work: drop it, or say what it was"
    )


NAMED = 3
"""Channels that were passed over and are named, those with the most usable steps; the table of steps has them all."""


def _channel(facts: Mapping[str, Any]) -> str:
    name = f"{facts['stream'].replace('_', ' ')} {facts['channel']}".strip()
    lead = facts["lead"]
    said = f"{name} of the {lead}" if lead else f"{name}, whose target the recording does not tell"
    said += f", with {_steps(facts)}" if _steps(facts) else ""
    why = {"shorted": "one contact against itself"}
    most = sorted(facts["passed"], key=lambda p: -(p.get("usable") or 0))
    passed = [(p["channel"], ", ".join(filter(None, (why.get(p["why"], p["why"]), _steps(p))))) for p in most]
    named = [f"{channel} ({reason})" for channel, reason in passed if reason]
    if not named:
        return said
    rest = len(named) - NAMED
    return f"{said}; not {', '.join(named[:NAMED])}" + (f" or {rest} other{'' if rest == 1 else 's'}" if rest > 0 else "")


def _steps(facts: Mapping[str, Any]) -> str:
    """Write the usable steps of a channel; empty in evidence without them."""
    usable = facts.get("usable")
    return "" if usable is None else f"{usable} usable step{'' if usable == 1 else 's'}"


def _program(facts: Mapping[str, Any]) -> str:
    each = ", ".join(f"program {p['number']} {_ran(p)}" for p in facts["programs"])
    several = sum(p["how"] == "moved" for p in facts["programs"]) > 1
    return f"{each}{': several moved, say which one the controller set' if several else ''}"


def _ran(program: Mapping[str, Any]) -> str:
    """Describe the stimulation of a program."""
    match program["how"]:
        case "moved":
            return f"{ma(program['low'])} to {ma(program['high'])} mA"
        case "constant":
            return f"constant at {ma(program['high'])} mA"
        case how:
            return {"off": "off", "unknown": "not known"}[how]


_NO_AMPLITUDE = "the file states no amplitude"


def _course(c: Course) -> str:
    """Describe the course of the amplitude of one side."""
    level = f"{ma(c.median)} {c.unit}" if c.median is not None else ""
    match c.pattern:
        case Pattern.UNKNOWN:
            return _NO_AMPLITUDE
        case Pattern.MOSTLY_UNKNOWN:
            return f"the amplitude is known in only {c.known} of {c.steps} steps"
        case Pattern.OFF:
            return f"the amplitude is 0 in all {c.known} steps where it is known"
        case Pattern.AT_CDBS:
            against = f" of {ma(c.cdbs_ma)} mA" if c.cdbs_ma else ""
            return f"about {level} throughout, within {100 * CDBS_TOLERANCE:.0f} % of the cDBS amplitude{against}"
        case Pattern.VARIES:
            return f"the amplitude varies between {ma(c.low)} and {ma(c.high)} {c.unit}: say which controller it was"
        case Pattern.CONSTANT_WITHOUT_CDBS:
            return f"the amplitude is constant at {level}, but no cDBS amplitude was stated for it when it was read"
        case Pattern.CONSTANT:
            return f"the amplitude is constant at {level}, {c.share:.0f} % of the cDBS amplitude: say which controller it was"


_SENTENCES: dict[Reason, Callable[[Mapping[str, Any]], str]] = {
    Reason.DAY_OF_VISIT: lambda f: f"recorded on {f['day']}, the day of visit {f['visit']}",
    Reason.NO_DATE: lambda f: "the file states no date: choose the visit",
    Reason.SEVERAL_VISITS: lambda f: f"{f['visits']} visits are dated {f['day']}: choose one",
    Reason.NO_VISIT_OF_DAY: lambda f: f"recorded on {f['day']}, and no visit has that date: choose the visit, or add it",
    Reason.AMPLITUDE: _amplitude,
    Reason.LOG: lambda f: f"its log names policy {f['policy']}",
    Reason.SLOT: lambda f: (
        f"its log is of session {f['position']} of the plan of visit {f['visit']}"
        + (f", whose key is sealed; visit {f['stated']}, which the upload says, is not taken" if "stated" in f else "")
    ),
    Reason.OTHER_VISIT: lambda f: (
        f"the upload says visit {f['stated']}, and its log is of session {f['position']} of the plan of visit {f['visit']}: choose one"
    ),
    Reason.SURVEY: _survey,
    Reason.CHANNEL: _channel,
    Reason.PROGRAM: _program,
    Reason.UNREADABLE: lambda f: f"its steps cannot be read: {f['detail']}",
    Reason.RECORDED_SIDE: lambda f: "of the recording that a controller could have seen",
    Reason.NO_SIDE: lambda f: "the file states no side",
    Reason.CUT_OUT: lambda f: f"cut out of proposed session {f['session']}",
}


def no_more_than(stored: Recording) -> str:
    """Describe a copy that holds no more than a stored recording."""
    return f"The same minutes of this device came before, as recording {stored.id}, which holds all of this: nothing was stored again."


def fuller_than(old: Recording, sessions: Sequence[int]) -> str:
    """Describe a copy that holds more than a stored recording."""
    several = len(sessions) > 1
    named = f"; session{'s' if several else ''} {', '.join(map(str, sessions))}"
    used = f"{named} use{'' if several else 's'} it from now on" if sessions else ""
    return f"A fuller copy of the minutes of recording {old.id} ({old.duration_s:.0f} s): it takes that one's place{used}."


def locked_copy(new: Recording, old: Recording, sessions: Sequence[int]) -> str:
    """Describe a copy that holds more than a stored recording, which sessions of a locked visit use."""
    named = f"session{'s' if len(sessions) > 1 else ''} {', '.join(map(str, sessions))}"
    return (
        f"A fuller copy (recording {new.id}) of the minutes of recording {old.id}, of which {named} of a locked visit is made: nothing was "
        f"changed there. To use the copy, have the visit unlocked, exclude {named} with a reason and confirm the session "
        "proposed of the copy."
    )


def beside(new: Recording, other: Recording) -> str:
    """Describe a recording of the same minutes as a stored one, neither of which holds all of the other."""
    return (
        f"Recording {other.id} holds minutes of the same device that this one (recording {new.id}) holds too, and the two differ, or each "
        "holds what the other lacks: both are kept, and their minutes count once. If it is one session, upload its whole folder."
    )


def count_parts(count: int) -> str:
    """Return the sentence on a file that holds several."""
    return f"It holds {count} recordings or tables, each of which was read as a file of its own."
