"""Names of channels: the words that may stay, the kind, side and contacts that they state, and scales of units."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Literal

from ml.formats.tables.cells.numbers import known_unit
from ml.formats.tables.columns import LFP_SCALE

Kind = Literal["lfp", "stimulation", "acceleration", "rotation", "opening", "other"]
Side = Literal["left", "right"]

_TARGETS = {t.lower(): t for t in ("STN", "GPi", "GPe", "VIM", "ANT", "CM", "PPN", "SNr", "ZI", "NAc", "M1", "S1", "PMC", "SMA", "PFC")}
_LFP = frozenset({"lfp", "dbs", "lead", "depth", "seeg", "ieeg", "ecog", "contact", "cont", "chan", "channel", "ch", "macro", "micro"})
_STIM = frozenset({"stim", "stimulation", "amplitude", "amp", "current", "dose"})
_MOTION = frozenset({"acc", "accel", "accelerometer", "acceleration", "imu"})
_ROTATION = frozenset({"gyr", "gyro", "gyroscope", "rotation"})
_OPENING = frozenset({"opening", "aperture"})
_OTHER = frozenset(
    ("eeg", "emg", "ecg", "ekg", "eog", "trig", "trigger", "status", "sync", "event", "events", "marker", "markers", "audio", "ref",
     "reference", "ground", "gnd", "misc", "resp", "temp", "hand", "finger", "force", "time", "timestamp",
     "battery", "mag", "magnetometer")
)  # fmt: skip
_SCALP = re.compile(r"(fp|af|f|ft|fc|t|c|tp|cp|p|po|o|a|m)(z|\d{1,2})", re.IGNORECASE)
_SIDES: dict[str, Side] = {"l": "left", "left": "left", "lh": "left", "r": "right", "right": "right", "rh": "right"}
_PLAIN = frozenset({"x", "y", "z", "a", "b", "c", "e", "raw", "filt", "uv", "mv", "ma", "v", "program", "of", "and", "anode", "cathode"})
_TOKEN = re.compile(r"[^\W\d_]+|\d+|[+-]")
_PAIR = re.compile(r"\+?(?<!\d)(\d{1,2})\s*[-–]\s*(?:[lr]\s?)?(\d{1,2})(?!\d)", re.IGNORECASE)
_NUMBER = re.compile(r"(\d{1,2})(?!.*\d)")
_TYPES: dict[str, Kind] = {
    "lfp": "lfp", "seeg": "lfp", "ieeg": "lfp", "ecog": "lfp", "dbs": "lfp", "accelerometer": "acceleration", "accel": "acceleration",
    "acc": "acceleration", "gyro": "rotation", "gyroscope": "rotation", "eeg": "other", "emg": "other", "ecg": "other",
    "eog": "other", "trig": "other", "markers": "other", "audio": "other", "mocap": "other", "gaze": "other",
}  # fmt: skip
LONGEST = 60
_MOTION_UNITS = {
    "g": "g", "m/s^2": "m/s2", "m/s2": "m/s2", "m/s²": "m/s2", "deg/s": "deg/s", "°/s": "deg/s", "dps": "deg/s", "rad/s": "rad/s",
}  # fmt: skip


@dataclass(frozen=True, slots=True)
class ChannelName:
    """Facts that a channel's name states.

    Attributes:
        text: the name in one spelling; empty where a word is not on the lists.
        contacts: plus and minus of a pair, or the one contact; empty where there is none.
        scalp: whether it is a place of the 10-20 system.
    """

    text: str
    kind: Kind
    side: Side | None
    target: str
    contacts: tuple[int, ...]
    scalp: bool = False

    @property
    def lead(self) -> str:
        """Side and target, as other formats name leads; empty where neither is known."""
        return " ".join(word for word in (self.side or "", self.target) if word)


def channel_name(label: str, of_type: str = "") -> ChannelName:
    """Read a channel's name; a name with any unknown word says nothing but its type."""
    typed = _TYPES.get(of_type.strip().lower())
    text = " ".join(label.replace("_", " ").replace("µ", "u").split())[: LONGEST + 1]
    if _SCALP.fullmatch(text) and typed != "lfp":
        return ChannelName(text, typed or "other", None, "", (), True)
    split = re.sub(r"(?<=\d)(?=[lr]\b)|\b([lr])(?=\d)", lambda m: f"{m[1]} " if m[1] else " ", text, flags=re.IGNORECASE)
    words = [w.lower() for w in _TOKEN.findall(split)]
    known = all(w.isdecimal() or w in "+-" or _known(w) for w in words) and len(text) <= LONGEST and not re.search(r"\d{4}", text)
    if not known or not words:
        return ChannelName("", typed or "lfp", None, "", ())
    names = set(words)
    sides = {_SIDES[w] for w in names & _SIDES.keys()}
    targets = {_TARGETS[w] for w in names & _TARGETS.keys()} | {t for t in ("M1", "S1") if t in text.upper().split()}
    kind: Kind = "lfp"
    if names & _ROTATION:
        kind = "rotation"
    elif names & _OPENING:
        kind = "opening"
    elif names & _MOTION:
        kind = "acceleration"
    elif names & _OTHER:
        kind = "other"
    elif names & _STIM:
        kind = "stimulation"
    elif typed is not None and not (targets or names & _LFP):
        kind = typed
    pair = _PAIR.search(split)
    contacts: tuple[int, ...] = (int(pair[1]), int(pair[2])) if pair else ()
    if not pair and kind == "lfp" and (single := _NUMBER.search(split)):
        contacts = (int(single[1]),)
    spelled = _PAIR.sub(lambda m: f"+{m[1]}-{m[2]}", split) if pair else text
    side = sides.pop() if len(sides) == 1 else None
    target = targets.pop() if len(targets) == 1 else ""
    return ChannelName(re.sub(r"[^\w\s+.-]", "", spelled).strip(), kind, side, target, contacts)


def _known(word: str) -> bool:
    lists = (_TARGETS, _LFP, _STIM, _MOTION, _ROTATION, _OPENING, _OTHER, _SIDES, _PLAIN)
    return any(word in one for one in lists)


def clean_label(label: str, of_type: str, number: int) -> tuple[str, bool]:
    """Return the name that may stay, and whether it is the file's; else it is numbered from 1."""
    known = bool(channel_name(label, of_type).text)
    return (label.strip(), True) if known else (f"channel {number}", False)


def clean_unit(text: str) -> str:
    """Return the unit in one spelling; empty where it is none of a signal."""
    unit = known_unit(" ".join(text.split())) or ""
    if unit in LFP_SCALE or unit in MA:
        return unit
    return _MOTION_UNITS.get(text.strip().lower(), "")


MA = {"mA": 1.0, "uA": 1e-3, "A": 1e3}
"""How many mA one of the unit is."""
TURNS = {"rad/s": 1.0, "deg/s": 0.017453292519943295}
"""How many rad/s one of the unit is."""
UV = LFP_SCALE
"""How many uV one of the unit is."""
