"""Names of channels by the table of electrodes: label, place and group, reduced to words that may stay."""

from __future__ import annotations

import re
from dataclasses import replace

from ml.formats.labs.names import ChannelName, Kind, channel_name, clean_label

LABELS = ("label", "channel_name", "electrode_name", "electrode_label", "contact", "contact_name", "name", "channel")
"""Columns that may have the label of an electrode; the first that is there counts."""
OTHER = ("scalp", "emg", "eeg", "ecg", "eog", "muscle", "skin")
_LONG = {
    "subthalamic": "STN", "subthalamic nucleus": "STN", "globus pallidus internus": "GPi", "globus pallidus internal": "GPi",
    "internal globus pallidus": "GPi", "globus pallidus externus": "GPe", "ventral intermediate": "VIM", "pedunculopontine": "PPN",
    "primary motor cortex": "M1", "zona incerta": "ZI", "substantia nigra": "SNr",
}  # fmt: skip


def place_of(text: str) -> str:
    """Reduce the place of an electrode, or the name of its group, to side and target, and `other` for one outside the brain."""
    plain = " ".join(re.findall(r"[^\W\d_]+|\d+", text.lower()))
    targets = {target for words, target in _LONG.items() if words in plain}
    words = plain.split()
    targets |= {found for word in words if (found := channel_name(word.upper() if word in ("m1", "s1") else word).target)}
    targets |= {joined for joined in ("M1", "S1") if joined.lower() in text.lower().split()}
    sides = {word for word in words if word in ("left", "right")}
    if not sides and (side := channel_name(text).side):
        sides = {side}
    if not targets and set(words) & set(OTHER):
        return "other"
    return " ".join([*(sides if len(sides) == 1 else ()), *(targets if len(targets) == 1 else ())])


def electrode_name(label: str, place: str, number: int) -> tuple[ChannelName, str]:
    """Read the name of an electrode, and return it with its name for people.

    A label states its contact; an electrode without one is numbered, and its number is no contact.

    Args:
        label: as `clean_label` left it. place: as `place_of` gave it. number: of the electrode, from 0.
    """
    own, where = channel_name(label), channel_name(place)
    if not own.text or label == f"channel {number + 1}":
        shown = " ".join(word for word in (place, f"electrode {number}") if word)
        kind: Kind = "other" if place == "other" else "lfp"
        return ChannelName(shown, kind, where.side, where.target, ()), shown
    side = own.side if where.side in (None, own.side) else None if own.side else where.side
    target = own.target if where.target in ("", own.target) else "" if own.target else where.target
    added = [word for word, there in ((where.side, own.side), (where.target, own.target)) if word and not there]
    shown = " ".join([*added, own.text])
    kind = "other" if place == "other" and own.kind == "lfp" else own.kind
    return replace(own, text=shown, kind=kind, side=side, target=target), shown


def kept_label(label: str, number: int) -> str:
    """Return the label that may stay; empty where a word of it is on no list."""
    found, own = clean_label(label, "", number + 1)
    return found if own else ""
