"""Closed vocabulary of Percept reports: names of keys, and what a person may have typed, are kept where they are made of these words alone.

A field with an unknown name may have a person's name. Of such a name the words of this list are shown, others as `…`.
"""

from __future__ import annotations

import re

from ml.formats.percept.keys import KEYS
from ml.formats.percept.report_json import SECTIONS

_PART = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|\d+|[^\W\d_]+|…")
_MOST_PARTS = 12

EVENT_WORDS = (
    "tremor",
    "dyskinesia",
    "stiffness",
    "rigidity",
    "bradykinesia",
    "slowness",
    "freezing",
    "walking",
    "fall",
    "balance",
    "speech",
    "dystonia",
    "pain",
    "cramp",
    "took medication",
    "medication",
    "feeling good",
    "streaming",
    "sleep",
    "exercise",
    "on",
    "off",
)
"""Names of patient events that stay; any other name may identify a person, and is shown as its number."""

SYMPTOMS = frozenset({w for name in EVENT_WORDS for w in name.split()} - {"on", "off", "took", "feeling", "good"})
"""Words that name a symptom or an activity by themselves."""

TYPED = SYMPTOMS | frozenset(
    re.findall(
        r"\w+",
        """
        on off took feeling good better worse same bad best worst no none slight mild moderate severe strong very more less left right both
        hand hands arm arms leg legs foot feet face neck trunk side resting rest action postural walk sitting standing lying talking
        stimulation dbs paresthesia tingling dizziness nausea anxiety mood fatigue gait start stop started stopped begin end before after
        medication dose turned up down finger tapping grasp task baseline movement artifact
        """,
    )
)
"""Words that a person may type into an annotation; a text with any other is removed."""

NAMING = frozenset(
    re.findall(
        r"\w+",
        """
        annotation annotations rating ratings score scores scale scales symptom symptoms severity note notes comment comments marker markers
        diary questionnaire survey surveys clinician patient reported record records entry entries list data value values level intensity
        label name text type kind time timestamp stamp utc unix offset seconds milliseconds ticks begin start end duration count number id
        summary event events log logs new version config configuration adaptive chronic timeline home
        """,
    )
)
"""Further words of keys, in addition to those of known keys."""

KEY_WORDS = frozenset(part.lower() for key in KEYS | SECTIONS for part in _PART.findall(key)) | NAMING | SYMPTOMS


def parts(key: str) -> list[str]:
    """Split a key into words in small letters: `SymptomRatings` and `symptom_ratings` are both `symptom`, `ratings`."""
    return [part.lower() for part in _PART.findall(key[:200])]


def technical(key: str) -> bool:
    """Decide whether every word of a key is a known technical one."""
    return "…" not in cleaned(key)


def cleaned(key: str) -> str:
    """Clean a key so that it may be shown: technical words stay, others become `…`."""
    out: list[str] = []
    for part in parts(key)[:_MOST_PARTS]:
        said = part if part in KEY_WORDS else "…"
        if said != "…" or out[-1:] != ["…"]:
            out.append(said)
    return " ".join(out) or "…"


def typed(text: str) -> str | None:
    """Return a text that a person may have typed, in small letters, where every word of it is known; None otherwise."""
    words = text.strip().lower().split() if len(text) <= 120 else []
    plain = [w.strip(".,;:!?()") for w in words]
    return " ".join(plain) if plain and all(w in TYPED for w in plain) else None
