"""Markers and annotations of a recording, reduced to what a closed grammar allows; and the dose that they state.

`parse(render(parse(text))) == parse(text)`, so a redacted file gives the same marks as the original.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
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
_SAME = frozenset({"boundary", "new segment", "rest", "task", "bad acq skip", "recording starts", "recording ends", "sync", "trigger"})
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
    """

    t_s: float
    label: str
    duration_s: float | None = None
    lasting: bool = False

    @property
    def statement(self) -> Statement:
        """The dose that its label states."""
        return parse(self.label)


def parse(text: str) -> Statement:
    """Parse a marker's text."""
    rest = text[:LONGEST].strip().lower().replace("_", " ")
    if rest in _SAME:
        return Statement(code=rest)
    if (code := _CODE.fullmatch(text[:LONGEST])) is not None:
        return Statement(code=f"{code['letter'] or ''} {int(code['number'])}".strip())
    found: dict[str, Any] = {}
    clear = len(text) <= LONGEST
    for name, (pattern, _) in _QUANTITIES.items():
        values = {float(value) for value in pattern.findall(rest)}
        clear &= len(values) < 2
        if len(values) == 1:
            found[name] = values.pop()
        elif values:
            found[name] = max(values)
        rest = pattern.sub(" ", rest)
    words = [word for word in _WORD.findall(rest) if word not in _PUNCTUATION]
    known = _ON | _OFF | _DOSE | _LEFT | _RIGHT | _PLAIN
    on, off = bool(_ON & set(words)), bool(_OFF & set(words))
    mentions = bool(_DOSE & set(words)) or bool({"amplitude_ma", "volts"} & found.keys()) or "ma" in words
    left, right = bool(_LEFT & set(words)), bool(_RIGHT & set(words))
    clear &= known.issuperset(words) and not (on and off)
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
        return OTHER
    parts = [] if statement.clear else [UNCLEAR]
    parts += ["stim"] + ([] if statement.on is None else ["on" if statement.on else "off"])
    parts += [statement.side] if statement.side else []
    parts += [text.format(value) for name, (_, text) in _QUANTITIES.items() if (value := getattr(statement, name)) is not None]
    return " ".join(parts)


def clean_text(text: str) -> str:
    """Reduce a marker's text to its label."""
    return render(parse(text))
