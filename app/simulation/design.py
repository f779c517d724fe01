"""Design of a simulated study: its size, its visit days and its state between runs. Nothing in here touches the service."""

from __future__ import annotations

import datetime as dt
import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

from app.learning.schemas import DEFAULT_SWEEP
from app.platform.errors import Conflict, Invalid
from ml.population import PARTICIPANTS

BETWEEN_VISITS: Final = dt.timedelta(days=28)
SINCE_LAST_VISIT: Final = dt.timedelta(days=14)
MORNING: Final = dt.time(9, 5, tzinfo=dt.UTC)
STATE_FILE: Final = "simulated-study.json"
VERSION: Final = 2
"""Of how a study is run; 1: visits that collect had no plan, and no session a bundle."""


@dataclass(frozen=True, kw_only=True)
class Preset:
    """Size of a simulated study.

    Attributes:
        visits: visits when none are asked for. random_visits: the first ones, which only collect, with the random controller.
        random_sessions: of such a visit, after one of cDBS.
        session_minutes: of every session but no-DBS (5 minutes). The paper's lasted 5-20.
        policies_per_kind: full-sized and distilled policies that a visit tests, of each; together the paper's 2-4.
        pipeline: params of the job between visits.
    """

    visits: int
    random_visits: int
    random_sessions: int
    session_minutes: int
    policies_per_kind: int
    pipeline: dict[str, Any]


PRESETS: Final = {
    "quick": Preset(
        visits=3,
        random_visits=1,
        random_sessions=4,
        session_minutes=5,
        policies_per_kind=1,
        pipeline={"preset": "quick", "count": 4, "updates": 1_000, "distil_updates": 500} | DEFAULT_SWEEP,
    ),
    # about the minutes of the paper's Table 1: 100 of RL, 100 of distilled RL, 35 without stimulation, and cDBS between any two
    "full": Preset(
        visits=7, random_visits=2, random_sessions=4, session_minutes=10, policies_per_kind=2, pipeline={"preset": "full"} | DEFAULT_SWEEP
    ),
}


@dataclass(frozen=True, kw_only=True)
class Design:
    """One simulated study: who, how many visits, from which seed, of which size."""

    participants: tuple[str, ...]
    visits: int
    seed: int
    preset: Preset

    def expected_sessions(self, visit: int) -> int:
        """Count the sessions of a visit's day, as it will be planned."""
        if visit <= self.preset.random_visits:
            return self.preset.random_sessions + 2  # a cDBS session before them, one without stimulation after
        return 4 * self.preset.policies_per_kind  # n policies, n - 1 cDBS sessions between them, one without stimulation

    def fine_tunes(self, visit: int) -> bool:
        """Decide if the job before a visit continues from the best tested policies: every second one; the first trains from scratch."""
        return (visit - self.preset.random_visits) % 2 == 0


def design(participants: Sequence[str], visits: int | None, seed: int, preset: str) -> Design:
    """Build the study that a command asks for.

    Raises:
        Invalid: a participant that is not simulated or named twice, an unknown preset, or fewer visits than two.
    """
    if preset not in PRESETS:
        raise Invalid(f"There is no preset '{preset}'.", f"Use one of {', '.join(PRESETS)}.")
    unknown = [code for code in participants if code not in PARTICIPANTS]
    if unknown or not participants or len(set(participants)) < len(participants):
        raise Invalid(
            f"'{','.join(participants)}' does not name synthetic participants, each once.", f"Choose from {','.join(PARTICIPANTS)}."
        )
    count = PRESETS[preset].visits if visits is None else visits
    if not 2 <= count <= 60:
        raise Invalid(f"A study of {count} visits cannot be simulated.", "Ask for 2 to 60 visits.")
    return Design(participants=tuple(participants), visits=count, seed=seed, preset=PRESETS[preset])


def visit_day(begun: dt.date, visits: int, number: int) -> dt.date:
    """Compute the date of a visit: a month apart, the last of `visits` two weeks before the study was begun."""
    return begun - SINCE_LAST_VISIT - (visits - number) * BETWEEN_VISITS


@dataclass(frozen=True)
class Remembered:
    """State of a study that its later runs must not change; `first` is the date of the first visit."""

    seed: int
    preset: dict[str, Any]
    first: dt.date


def remember(path: Path, wanted: Design, today: dt.date) -> Remembered:
    """Read the study of this data folder, or record it when it is begun.

    Raises:
        Conflict: another study was begun here.
    """
    size = asdict(wanted.preset)
    if path.exists():
        stored = json.loads(path.read_text("utf-8"))
        if stored.get("version") != VERSION:
            raise Conflict(
                "The simulated study in this data folder was begun by another version of betaloop, which ran its sessions in another way.",
                "Choose another folder (BETALOOP_DATA_DIR); what it holds stays as it is.",
            )
        if (stored["seed"], stored["preset"]) != (wanted.seed, json.loads(json.dumps(size))):
            other = "" if stored["seed"] != wanted.seed else " and another preset"
            raise Conflict(
                f"A simulated study with seed {stored['seed']}{other} was begun in this data folder.",
                "Ask for the same seed and preset to go on, or choose another folder (BETALOOP_DATA_DIR).",
            )
        return Remembered(stored["seed"], stored["preset"], dt.date.fromisoformat(stored["first"]))
    first = visit_day(today, wanted.visits, 1)
    path.parent.mkdir(parents=True, exist_ok=True)
    draft = path.with_suffix(".part")
    draft.write_text(json.dumps({"version": VERSION, "seed": wanted.seed, "preset": size, "first": first.isoformat()}), "utf-8")
    draft.replace(path)
    return Remembered(wanted.seed, size, first)
