"""Markers and annotations of a recording, reduced to what a closed grammar allows; and the dose that they state.

`parse(render(parse(text))) == parse(text)`, so a redacted file gives the same marks as the original.
"""

from __future__ import annotations

import hmac
import re
from dataclasses import dataclass, replace
from hashlib import sha256
from typing import Any, Literal

Side = Literal["left", "right"]

LONGEST = 200
"""Characters of a marker that are read."""
_QUANTITIES = {
    "amplitude_ma": (re.compile(r"(?<![\w.,-])(\d{1,2}(?:\.\d{1,3})?)\s*ma\b"), "{:g} mA"),
    "volts": (re.compile(r"(?<![\w.,-])(\d{1,2}(?:\.\d{1,3})?)\s*v(?:olts?)?\b"), "{:g} V"),
    "rate_hz": (re.compile(r"(?<![\w.,-])(\d{1,3}(?:\.\d{1,2})?)\s*hz\b"), "{:g} Hz"),
    "width_us": (re.compile(r"(?<![\w.,-])(\d{1,4})\s*(?:us|µs|μs)\b"), "{:g} us"),
}
_ON = frozenset({"on", "start", "started", "begin"})
_OFF = frozenset({"off", "stop", "stopped", "end"})
_DOSE = frozenset({"stim", "stimulation", "dbs", "therapy", "amplitude", "amp", "current"})
_LEFT, _RIGHT = frozenset({"l", "left", "lh"}), frozenset({"r", "right", "rh"})
_PLAIN = frozenset({"set", "to", "at", "both", "bilateral", "bi", "stn", "gpi", "vim", "sides"})
_WORD = re.compile(r"[^\W\d_]+|\d+|\S")
_PUNCTUATION = frozenset(",;:=@/()[]|-_.")
_CODE = re.compile(r"\s*(?:(?P<letter>[SRTE])\s*)?(?P<number>\d{1,3})\s*")
_TOKEN = re.compile(r"(?P<kind>marker|note) (?P<token>[0-9a-f]{12})(?: (?P<rest>.*))?", re.DOTALL)
_LISTED = """
    a active amplitude arm artefact baseline begin block break calibration change clinical close condition contact cue current dbs end
    error eyes finger fixation foot group hand left level medication mild moderate move movement no not o of off on open pause phase
    position program pulse ramp rate response rest resting right run setting severe side sit start state step stim stimulation
    stimulator stimulus stop strong sync tapping target task test therapy trial trigger walk walking width
"""
SHOWN_WORDS = frozenset(_LISTED.split())
"""Words of unknown markers that are shown; none of them is a person's name."""
SOFTWARE = _SAME = frozenset(
    {"boundary", "new segment", "rest", "task", "bad acq skip", "recording starts", "recording ends", "sync", "trigger"}
)
"""Words of software that may stay."""
OTHER = "marker"
"""Label of a marker with words that are not kept."""
UNCLEAR = "note"
"""First word of a label that mentions a dose among words that are not known, so that it states none."""


@dataclass(frozen=True, slots=True)
class Statement:
    """Dose that a marker states.

    Attributes:
        on: True, False, or None where it does not say.
        mentions: whether it speaks of stimulation at all.
        clear: False where the text has other words too, or states two values: the dose is unknown after it.
        code: of a marker that is a number, such as `S 1`; or its word.
        words: keyed hash of a text with unknown words, by which a lab's meaning of it is found; empty for others, and before redaction.
        shown: those of its words that may be shown to a person, `…` for the others.
    """

    on: bool | None = None
    side: Side | None = None
    amplitude_ma: float | None = None
    volts: float | None = None
    rate_hz: float | None = None
    width_us: float | None = None
    mentions: bool = False
    clear: bool = True
    code: str = ""
    words: str = ""
    shown: str = ""

    @property
    def key(self) -> str:
        """Name under which a lab's meaning of this marker is kept; empty where it needs none."""
        lost = self.mentions and not self.clear and not self.words  # a mark in the place of lost ones
        if self.code in SOFTWARE or lost or (self.mentions and self.dose_ma is not None):
            return ""
        return self.words or self.code or (render(self) if self.mentions else "")

    @property
    def dose_ma(self) -> float | None:
        """Amplitude in force from here on, mA; None where it is unknown."""
        if not self.clear or self.volts is not None:
            return None
        if self.on is False:
            return 0.0 if not self.amplitude_ma else None
        return self.amplitude_ma


@dataclass(frozen=True, slots=True)
class Mark:
    """A marker.

    Attributes:
        t_s: time, s of the file's clock. label: cleaned. duration_s: how long it lasts; None: it is of one moment.
        lasting: whether it holds for its duration whatever was recorded, as a row of a table of events does.
        explained: dose that the lab says it states, in the place of what the label states.
    """

    t_s: float
    label: str
    duration_s: float | None = None
    lasting: bool = False
    explained: Statement | None = None

    @property
    def statement(self) -> Statement:
        """The dose that it states."""
        return self.explained or parse(self.label)


def parse(text: str) -> Statement:
    """Parse a marker's text."""
    if (kept := _TOKEN.fullmatch(text[:LONGEST].strip())) is not None:
        if kept["kind"] == UNCLEAR:
            return replace(_parse_words(kept["rest"] or "", False), words=kept["token"])
        return Statement(words=kept["token"], shown=_screen(kept["rest"] or ""))
    rest = text[:LONGEST].strip().lower().replace("_", " ")
    if rest in _SAME:
        return Statement(code=rest)
    if (code := _CODE.fullmatch(text[:LONGEST])) is not None:
        return Statement(code=f"{code['letter'] or ''} {int(code['number'])}".strip())
    return _parse_words(text, len(text) <= LONGEST)


def _parse_words(text: str, clear: bool) -> Statement:
    """Parse the words and quantities of a marker. A quantity with two values is dropped, since neither can be the one."""
    rest = text[:LONGEST].strip().lower().replace("_", " ")
    found: dict[str, Any] = {}
    several = False
    for name, (pattern, _) in _QUANTITIES.items():
        values = {float(value) for value in pattern.findall(rest)}
        several |= len(values) > 1
        if len(values) == 1:
            found[name] = values.pop()
        rest = pattern.sub(" ", rest)
    words = [word for word in _WORD.findall(rest) if word not in _PUNCTUATION]
    known = _ON | _OFF | _DOSE | _LEFT | _RIGHT | _PLAIN
    on, off = bool(_ON & set(words)), bool(_OFF & set(words))
    mentions = several or bool(_DOSE & set(words)) or bool({"amplitude_ma", "volts"} & found.keys()) or "ma" in words
    left, right = bool(_LEFT & set(words)), bool(_RIGHT & set(words))
    clear &= known.issuperset(words) and not (on and off) and not several
    if not mentions and not found:
        return Statement()
    state = on if on != off else None
    side: Side | None = "left" if left and not right else "right" if right and not left else None
    return Statement(on=state, side=side, mentions=True, clear=clear, **found)


def render(statement: Statement) -> str:
    """Write the label in one fixed spelling; `marker` where nothing of it is known."""
    if statement.code:
        return statement.code
    if not statement.mentions:
        return " ".join(word for word in (OTHER, statement.words, statement.shown) if word)
    parts = [] if statement.clear else [UNCLEAR, *([statement.words] if statement.words else [])]
    parts += ["stim"] + ([] if statement.on is None else ["on" if statement.on else "off"])
    parts += [statement.side] if statement.side else []
    parts += [text.format(value) for name, (_, text) in _QUANTITIES.items() if (value := getattr(statement, name)) is not None]
    return " ".join(parts)


def clean_text(text: str, key: bytes) -> str:
    """Reduce a marker's text to its label. One with unknown words gets their keyed hash, so that a lab's meaning of it is found again.

    Args:
        text: as the file has it.
        key: secret of the installation.
    """
    found = parse(text)
    if found.code or found.words or (found.mentions and found.clear) or text.strip().lower() in ("", OTHER):
        return render(found)
    shown = "" if found.mentions else _screen(text)
    return render(replace(found, words=_token(text, key), shown=shown))


def _token(text: str, key: bytes) -> str:
    """Hash the words of a text, whatever quantities, spaces and capitals it has."""
    plain = text.strip().lower().replace("_", " ")
    for name, (pattern, _) in _QUANTITIES.items():
        plain = pattern.sub(f" {name} ", plain)
    return hmac.new(key, f"marker {' '.join(plain.split())}".encode(errors="replace"), sha256).hexdigest()[:12]


def _screen(text: str) -> str:
    """Keep the words that may be shown."""
    words = [word if word in SHOWN_WORDS else "…" for word in re.findall(r"[^\W\d_]+|…", text[:LONGEST].lower())]
    return " ".join(word for i, word in enumerate(words) if word != "…" or i == 0 or words[i - 1] != "…")[:60].strip()
