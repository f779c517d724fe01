"""Outcomes that an installation defines by a file, BETALOOP_OUTCOMES: what a study measures beyond those of the paper.

The file is YAML, a list `outcomes`. An entry is a ready definition (`use`, and its margin), or a whole one: `key`, `label`, `unit`, `low`,
`high`, `better` and `margin`. `_FIELDS` names what else it may have. The margin has no default: how much worse counts as no worse is the
study's to state. A second list, `judged`, names the outcomes that verdicts rest on where these are not all.

Such an outcome is entered, shown, exported and judged like the others. Evaluation does not predict it, and it has no part in r_end.
"""

from __future__ import annotations

import math
import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Final, NamedTuple

import yaml  # type: ignore[import-untyped]
from dotenv import dotenv_values

from ml.outcomes.records import Margin, Outcome

VARIABLE: Final = "BETALOOP_OUTCOMES"
_KEY = re.compile(r"[a-z][a-z0-9_]{1,29}")
_RESERVED = frozenset({
    "energy", "mean_beta", "r_end", "beta", "amplitude", "id", "session_id", "revision", "entered_by", "reason", "derived",
    "from_day", "created_at", "created_by", "version", "sure", "participant", "participant_id", "visit", "visit_id", "date",
    "minutes", "controller", "note", "qoc", "session", "margins",
})  # fmt: skip
_FIELDS = frozenset({
    "use", "key", "label", "short", "noun", "unit", "low", "high", "whole", "decimals", "better", "usual", "margin", "failure",
    "help",
})  # fmt: skip
_NEEDED = ("key", "label", "unit", "low", "high", "better", "margin")

READY: Final[Mapping[str, Mapping[str, Any]]] = {
    "mds_updrs_iii": {
        "label": "MDS-UPDRS part III", "short": "UPDRS III", "unit": "of 132", "low": 0, "high": 132, "whole": True, "better": "lower",
        "help": "Sum of the 33 scores of the motor examination.",
    },
    "mds_updrs_speech": {
        "label": "MDS-UPDRS 3.1, speech", "short": "Speech", "noun": "speech", "unit": "of 4", "low": 0, "high": 4, "whole": True,
        "better": "lower", "help": "Item 3.1 of the motor examination.",
    },
    "mds_updrs_gait": {
        "label": "MDS-UPDRS 3.10, gait", "short": "Gait", "noun": "gait", "unit": "of 4", "low": 0, "high": 4, "whole": True,
        "better": "lower", "help": "Item 3.10 of the motor examination.",
    },
    "udysrs": {
        "label": "UDysRS", "short": "UDysRS", "unit": "of 104", "low": 0, "high": 104, "whole": True, "better": "lower",
        "help": "Unified Dyskinesia Rating Scale, total score.",
    },
    "gait_speed": {
        "label": "Gait speed", "short": "Gait speed", "noun": "gait speed", "unit": "m/s", "low": 0, "high": 4, "better": "higher",
        "decimals": 2, "usual": [0.2, 2.0], "help": "Walking speed over a stated distance.",
    },
}  # fmt: skip
"""Names and ranges of known scales. Sources: Goetz et al. 2008 (Movement Disorders 23), MDS-UPDRS; Goetz et al. 2008, UDysRS."""


class DefinitionError(SystemExit):
    """A file of outcomes cannot be used; the text says where, and what to write instead.

    It ends every program that loads the outcomes, with this text in place of a traceback: none of them may go on with others.
    """


class Definitions(NamedTuple):
    """Outcomes of an installation, and the keys of those that verdicts judge; None where they judge all."""

    outcomes: tuple[Outcome, ...] = ()
    judged: frozenset[str] | None = None


def defined_outcomes(built_in: Sequence[Outcome]) -> Definitions:
    """Read the outcomes that this installation defines.

    Args:
        built_in: whose names are taken.

    Raises:
        DefinitionError: the file that the variable names is missing, or is no such definition.
    """
    stated = os.environ.get(VARIABLE) or (dotenv_values(".env").get(VARIABLE) if Path(".env").is_file() else None)
    return read_definitions(Path(stated), built_in) if stated else Definitions()


def read_definitions(path: Path, built_in: Sequence[Outcome]) -> Definitions:
    """Read outcomes from a file. Raises as `defined_outcomes`."""
    try:
        content = yaml.safe_load(path.read_text("utf-8"))
    except OSError as error:
        raise DefinitionError(f"{path}, which {VARIABLE} names, cannot be read: {error.strerror}.") from error
    except (UnicodeDecodeError, yaml.YAMLError) as error:
        raise DefinitionError(f"{path} is no YAML: {' '.join(str(error).split())}.") from error
    if not isinstance(content, dict) or "outcomes" not in content or not set(content) <= {"outcomes", "judged"}:
        raise DefinitionError(f"{path} needs a list, `outcomes:`, with an entry for each outcome, and may have another, `judged:`.")
    entries = content["outcomes"]
    if not isinstance(entries, list):
        raise DefinitionError(f"{path}: `outcomes` must be a list with an entry for each outcome, not {entries!r}.")
    found: list[Outcome] = []
    for number, entry in enumerate(entries, 1):
        where = f"{path}, outcome {number}"
        try:
            made = _outcome(entry)
        except ValueError as error:
            raise DefinitionError(f"{where}: {error}.") from error
        taken = {name for o in (*built_in, *found) for name in (o.key, o.field, o.column, o.margin.field, o.label.lower(), o.short.lower())}
        clash = {made.key, made.margin.field, made.label.lower(), made.short.lower()} & taken
        if clash:
            raise DefinitionError(f"{where}: another outcome has the name {min(clash)!r}; choose another.")
        found.append(made)
    return Definitions(tuple(found), _judged_keys(path, content.get("judged"), [o.key for o in (*built_in, *found)]))


def _judged_keys(path: Path, value: Any, keys: Sequence[str]) -> frozenset[str] | None:
    """Read the keys of the outcomes that verdicts judge. Raises DefinitionError."""
    if value is None:
        return None
    if not isinstance(value, list) or not value or not all(isinstance(key, str) and key in keys for key in value):
        raise DefinitionError(f"{path}: `judged` must be a list of some of {', '.join(keys)}, not {value!r}.")
    return frozenset(value)


def _outcome(entry: Any) -> Outcome:
    """Make the record of an entry. Raises ValueError."""
    if not isinstance(entry, dict) or not all(isinstance(name, str) for name in entry):
        raise ValueError(f"an entry is a list of names and values, not {entry!r}")
    if unknown := sorted(set(entry) - _FIELDS):
        raise ValueError(f"{unknown[0]!r} is not known here; known are {', '.join(sorted(_FIELDS))}")
    ready = entry.get("use")
    if ready is not None and ready not in READY:
        raise ValueError(f"there is no ready definition {ready!r}; there are {', '.join(READY)}")
    known = {"key": ready, **READY[ready]} if ready is not None else {}
    whole = {**known, **{name: value for name, value in entry.items() if name != "use"}}
    if missing := [name for name in _NEEDED if name not in whole]:
        raise ValueError(f"{missing[0]!r} is missing{_MARGIN_HINT if missing[0] == 'margin' else ''}")
    key, label, unit = (_text(whole, name) for name in ("key", "label", "unit"))
    if not _KEY.fullmatch(key) or key in _RESERVED:
        raise ValueError(f"key {key!r} must be small letters, digits and _, begin with a letter, have 2 to 30 characters, and no other use")
    if whole["better"] not in ("higher", "lower"):
        raise ValueError(f"better must be 'higher' or 'lower', not {whole['better']!r}")
    low, high = _number(whole, "low"), _number(whole, "high")
    higher, integer = whole["better"] == "higher", whole.get("whole", False)
    if not isinstance(integer, bool):
        raise ValueError(f"whole must be true or false, not {integer!r}")
    decimals = whole.get("decimals", 1)
    if not isinstance(decimals, int) or not 0 <= decimals <= 4:
        raise ValueError(f"decimals must be 0 to 4, not {decimals!r}")
    noun, short = (_text(whole, name) if name in whole else label for name in ("noun", "short"))
    scale = unit.startswith("of ")
    points = "points" if scale else unit
    text = _text(whole, "help") if "help" in whole else f"{label}."
    span = f"{low:g} to {high:g}{'' if scale else f' {unit}'}"
    return Outcome(
        key=key,
        field=key,
        column=key,
        label=label,
        short=short,
        noun=noun,
        the_noun=noun if noun != noun.lower() else f"the {noun}",
        unit=unit,
        entry_unit=unit,
        sentence_unit=unit,
        difference_unit=points,
        difference_words=points,
        contrast_unit=points,
        worse="lower" if higher else "higher",
        help=text,
        explained=f"{text} {span}; {'more' if higher else 'less'} is better.",
        description=f"{label}, {span}.",
        exported=f"{label}, {span}, newest revision.",
        low=low,
        high=high,
        usual=_usual(whole.get("usual"), low, high),
        whole=integer,
        decimals=decimals,
        mean_decimals=decimals,
        higher_is_better=higher,
        margin=_margin(whole["margin"], key, label, unit, points, higher, (low, high)),
        failure=_failure(whole.get("failure", "worst measured")),
        resolution=1.0 if integer else 0.0,
        bounded=scale,
    )


_MARGIN_HINT = "; write how much worse counts as no worse, as {points: 4} or {share: 0.1}"


def _margin(entry: Any, key: str, label: str, unit: str, points: str, higher: bool, ends: tuple[float, float]) -> Margin:
    """Make the margin of an entry, `{points: 4}` or `{share: 0.1}`. Raises ValueError."""
    if not isinstance(entry, dict) or len(entry) != 1 or not set(entry) <= {"points", "share"}:
        raise ValueError(f"margin must be one of points and share{_MARGIN_HINT}; it is {entry!r}")
    ((kind, _),) = entry.items()
    low, high = ends
    span = high - low
    value = _number(entry, kind)
    if kind == "points" and not 0 < value < span:
        raise ValueError(f"a margin of {value:g} {points} must be above 0 and below the whole range of {span:g}")
    lower = "lower" if higher else "higher"
    of = "of the value under cDBS" if kind == "share" else points
    return Margin(
        field=f"{key}_margin",
        kind="share" if kind == "share" else "points",
        default=value,
        least=0.01 if kind == "share" else span / 1000,
        most=0.5 if kind == "share" else span,
        unit=of,
        label=f"{label} {lower} by",
        help="Share of the value under cDBS, 0.1 being 10 %." if kind == "share" else f"On the scale of {low:g} to {high:g}, in {points}.",
        form_unit="of cDBS" if kind == "share" else points,
        description=f"{label} may be {lower} by this {'share of the value under cDBS' if kind == 'share' else f'much, {points}'}.",
    )


def _text(entry: Mapping[str, Any], name: str) -> str:
    value = entry[name]
    if not isinstance(value, str) or not value.strip() or len(value) > 120:
        raise ValueError(f"{name} must be a text of 1 to 120 characters, not {value!r}")
    return value.strip()


def _number(entry: Mapping[str, Any], name: str) -> float:
    value = entry[name]
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
        raise ValueError(f"{name} must be a number, not {value!r}")
    return float(value)


def _usual(value: Any, low: float, high: float) -> tuple[float, float] | None:
    """Read the usual range, `[0.2, 2.0]`. Raises ValueError."""
    if value is None:
        return None
    if not isinstance(value, list) or len(value) != 2:
        raise ValueError(f"usual must be two numbers, as [0.2, 2.0], not {value!r}")
    first, last = (_number({"usual": end}, "usual") for end in value)
    if not low <= first < last <= high:
        raise ValueError(f"usual must lie within {low:g} to {high:g}, the lower end first, not {value!r}")
    return first, last


def _failure(value: Any) -> float | None:
    """Read what a session stopped for the participant's sake counts as: a number, or the worst measured. Raises ValueError."""
    return None if value == "worst measured" else _number({"failure": value}, "failure")
