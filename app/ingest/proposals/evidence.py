"""What a recording seems to be, by plain rules, each with the sentence that says why. A person confirms or corrects it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, date, datetime

import numpy as np
from numpy.typing import NDArray

from app.study.models import Controller, Visit
from app.study.sessions.contradictions import Delivered

CDBS_TOLERANCE = 0.05
"""A constant amplitude within this share of the cDBS amplitude is taken for cDBS."""
KNOWN_SHARE = 0.5
"""Share of a session's steps whose amplitude must be known before anything is guessed from it."""
NOT_TOLD = "the file tells no amplitude"


@dataclass(frozen=True)
class VisitGuess:
    """The visit that a recording belongs to; `open`: it is only kept there until a person says which."""

    visit: Visit
    open: bool
    why: str


def guess_visit(visits: Sequence[Visit], day: date | None, stated: Visit | None, today: date | None = None) -> VisitGuess:
    """The stated visit, else the one on the recording's day, else an open place in the newest one that has taken place.

    Args:
        visits: of the participant, by number; at least one.
        day: on which the recording was made, by the clock of the place where its file tells it.
    """
    if stated is not None:
        return VisitGuess(stated, False, "as stated with the upload")
    if day is not None:
        same = [v for v in visits if v.date == day]
        if len(same) == 1:
            return VisitGuess(same[0], False, f"recorded on {day}, the day of visit {same[0].number}")
    today = today or datetime.now(UTC).date()
    past = [v for v in visits if v.date is None or v.date <= today]
    place = (past or list(visits))[-1]
    if day is None:
        return VisitGuess(place, True, "the file tells no date: choose the visit")
    if len(same) > 1:
        return VisitGuess(same[0], True, f"{len(same)} visits are dated {day}: choose one")
    return VisitGuess(place, True, f"recorded on {day}, and no visit has that date: choose the visit, or add it")


def guess_controller(sides: Sequence[Delivered]) -> tuple[Controller | None, str]:
    """No DBS where no side was stimulated, cDBS where every side is constant at its cDBS amplitude, else left open; and why.

    Args:
        sides: of all recordings of the session. One whose amplitude is not known leaves the controller open.
    """
    judged = [(side.name, *_judge(side)) for side in sides]
    if len(judged) == 1:
        return judged[0][1], judged[0][2]
    if not judged:
        return None, NOT_TOLD
    guesses = {guess for _, guess, _ in judged}
    said = "; ".join(f"{name}: {why}" for name, _, why in judged)
    if len(guesses) == 1:
        return guesses.pop(), said
    return None, f"the sides do not agree, so that a person must say which controller it was ({said})"


def _judge(side: Delivered) -> tuple[Controller | None, str]:
    amount, fraction, in_ma = side.inside
    scale, unit = (1.0, "mA") if in_ma else (100.0, "% of cDBS")
    known = scale * amount[~np.isnan(amount)]
    if known.size == 0:
        return None, NOT_TOLD
    if known.size < KNOWN_SHARE * amount.size:
        return None, f"the amplitude is known in only {known.size} of {amount.size} steps"
    low, high = float(known.min()), float(known.max())
    if side.silent:
        return Controller.NO_DBS, f"the amplitude is 0 in all {known.size} steps where it is known"
    relative = fraction[~np.isnan(fraction)]
    level = f"{float(np.median(known)):.3g} {unit}"
    if relative.size and np.all(np.abs(relative - 1) <= CDBS_TOLERANCE + 1e-6):
        cdbs_ma = side.table.cdbs_ma if side.table else None
        against = f" of {cdbs_ma:.3g} mA" if cdbs_ma else ""
        return Controller.CDBS, f"about {level} throughout, within {100 * CDBS_TOLERANCE:.0f} % of the cDBS amplitude{against}"
    if not _constant(known):
        return None, f"the amplitude varies between {low:.3g} and {high:.3g} {unit}: say which controller it was"
    if relative.size == 0:
        return None, f"the amplitude is constant at {level}, but no cDBS amplitude is stated to hold it against"
    share = 100 * float(np.median(relative))
    return None, f"the amplitude is constant at {level}, {share:.0f} % of the cDBS amplitude: say which controller it was"


def _constant(known: NDArray[np.float64]) -> bool:
    middle = float(np.median(known))
    return bool(np.all(np.abs(known - middle) <= CDBS_TOLERANCE * middle))
