"""Form for a draft: policies, sessions near a stated amplitude, and the rules of the day."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy.orm import Session
from starlette.datastructures import FormData

from app.accounts.permissions import Caller
from app.evaluation.ranking.answer import Answer, Row
from app.evaluation.ranking.assessment import cdbs_amplitude_now
from app.evaluation.ranking.decisions import findings_of
from app.evaluation.ranking.judged import Judged
from app.evaluation.ranking.service import current
from app.evaluation.ranking.verdict_wording import plainly
from app.learning import repository as learning
from app.planning.grounds import events_against
from app.planning.plans import wording
from app.planning.plans.designs import offered
from app.planning.plans.schemas import HeldIn, LimitIn, PlanIn, PlanOptions
from app.planning.plans.service import rules_of
from app.planning.plans.suggested import Held, held_in, suggested
from app.planning.plans.view import PlanView
from app.planning.protocol.schedule import most_policies, total_minutes
from app.platform.errors import Invalid, NotFound
from app.platform.web.forms import parse
from app.tables.learning import Policy
from app.tables.participants import Participant
from app.tables.visits import Visit
from ml.designs import EARLY_RANDOM_SESSIONS, LOW_AMPLITUDE, Bound
from ml.ope.posterior.further_sessions import MOST_HELD, Place

LABELS = {
    "minutes_per_session": "Minutes per session",
    "total_minutes": "Minutes of the visit",
    "washout_minutes": "Washout",
    "random_sessions": "Random sessions",
    "no_dbs_minutes": "No-DBS session",
    "repeats": "Sessions of each policy",
    "order": "Order",
    "break_minutes": "Break",
    "starts_at": "First session at",
    "hemisphere": "Side that the controllers set",
    "min_ma": "Lowest amplitude",
    "max_ma": "Highest amplitude",
    "ramp_ma_per_s": "Fastest change",
    "note": "Note on the sheet",
    "min_fraction": "Lowest amplitude, share of cDBS",
    "reason": "Why the approved plan is replaced",
    "amplitude_ma": "Held near, mA",
    "amplitude_fraction": "Held near, share of cDBS",
    "sessions": "Sessions held near it",
    "visit_id": "Visit",
    "visit_number": "Number of the new visit",
    "visit_date": "Date of the new visit",
}


UNITS = ("amplitude_ma", "amplitude_fraction")
"""In which the form names amplitudes."""
MOST_ROWS = 5


def draft_of(values: FormData) -> PlanIn:
    """Parse the form to the API's type."""
    ids = [str(v) for v in values.getlist("policy_ids")]
    wrong = [i for i in ids if not (i.isdecimal() and 0 < int(i) < 2**31)]
    if wrong:
        raise Invalid(f"'{wrong[0]}' is no policy.", "Choose policies of the list.", field="policy_ids")
    if len(ids) > 20:
        raise Invalid(f"{len(ids)} policies are chosen; a visit takes 20 at most.", "Tick fewer.", field="policy_ids")
    options = parse(PlanOptions, values, LABELS)
    reasons, lowest = ({i: str(values.get(f"{name}_{i}", "")).strip() for i in ids} for name in ("override", "limit"))
    overrides = [{"policy_id": int(i), "reason": text} for i, text in reasons.items() if text]
    limits = [
        parse(LimitIn, {"policy_id": i, "min_fraction": text}, LABELS, {"min_fraction": f"limit_{i}"}) for i, text in lowest.items() if text
    ]
    return PlanIn.model_validate(
        {"policy_ids": [int(i) for i in ids], "overrides": overrides, "limits": limits, "held": held_of(values)}
        | options.model_dump(exclude_unset=True)
    )


def shown_of(db: Session, visit: Visit, caller: Caller, full: PlanView | None, values: FormData | None) -> dict[str, Any]:
    """Build the content of the form for a draft."""
    participant = visit.participant
    try:
        found: Judged | None = current(db, participant, caller)
    except NotFound:
        found = None
    defaults = rules_of(PlanOptions())
    choices = _choices(db, participant, found.answer if found is not None else None)
    slots, settings = most_policies(defaults), participant.current_settings
    place = Place(settings.bound, round(60 * defaults.session_minutes / settings.period_s), settings.period_s)
    suggestions = suggested(found, slots)
    return {
        "ranking": found,
        "typed": values or {},
        "choices": choices,
        "no_choice": "" if choices else learning.no_candidate(db, participant.id),
        "suggestions": [(s.policy, wording.suggestion(s.why, first=k == 0)) for k, s in enumerate(suggestions)],
        "held_rows": held_rows(values, held_in(found, slots - len(suggestions), place), place.bound, cdbs_amplitude_now(participant)),
        "holding": wording.holding,
        "low_amplitude": LOW_AMPLITUDE,
        "most_held": MOST_HELD,
        "form_values": _form_values(full, values, choices),
        "chosen": _chosen(None if full is not None and full.sealed else full, values),
        "orders": wording.ORDER_NAMES,
        "fit": [(n, total_minutes(n, defaults)) for n in range(1, slots + 1)],
        "defaults": defaults,
    }


@dataclass(frozen=True)
class Choice:
    """A policy that may be planned, and what the ranking says of it.

    Attributes:
        row: its own; None without a ranking of it. harmful: uncleared serious adverse events and stops under it, in words.
        twins: policies that do the same by the ranking.
    """

    policy: Policy
    row: Row | None
    harmful: str
    twins: tuple[Choice, ...] = ()


def _choices(db: Session, participant: Participant, answered: Answer | None) -> list[Choice]:
    """List behaviours that may be planned, what to test first; policies that no ranking contains come last."""
    rows, heads = (answered.everyone(), answered.heads()) if answered is not None else ({}, {})
    places = {i: k for k, i in enumerate(rows)}
    policies = sorted(learning.candidates(db, participant.id), key=lambda p: (places.get(p.id, len(places)), p.id))
    harmful = events_against(db, participant)
    known = {p.id for p in policies}  # a retired one is in the ranking, and may not be planned
    groups: dict[int, list[Choice]] = {}
    for p in policies:
        head = heads.get(p.id, p.id)
        groups.setdefault(head if head in known else p.id, []).append(
            Choice(p, rows.get(p.id), plainly(findings_of(harmful.get(p.id, ()))))
        )
    return [replace(first, twins=tuple(others)) for first, *others in groups.values()]


def _chosen(view: PlanView | None, values: FormData | None) -> Sequence[int]:
    if values is not None:
        return [int(v) for v in map(str, values.getlist("policy_ids")) if v.isdecimal()]
    return [line.item.policy_id for line in view.lines if line.item.policy_id] if view else []


def _form_values(view: PlanView | None, values: FormData | None, choices: Sequence[Any]) -> dict[str, Any]:
    """Return the values of the form: what was sent, else the present plan's note, else the defaults."""
    shown: dict[str, Any] = {k: f"{v:g}" if isinstance(v, float) else v for k, v in PlanOptions().model_dump().items()}
    if view:
        shown["note"] = view.plan.note
    elif not choices:
        shown["random_sessions"] = EARLY_RANDOM_SESSIONS
    if values is not None:
        shown |= {name: str(values[name]) for name in shown if name in values} | {
            "no_dbs": "no_dbs" in values,
            "blinded": "blinded" in values,
        }
    return shown


@dataclass(frozen=True)
class HeldRow:
    """One row of the form.

    Attributes:
        unit: of `UNITS`. amplitude, sessions: the texts of the fields. why: what the sessions would show; None of a free row.
    """

    unit: str
    amplitude: str
    sessions: str
    why: Held | None = None


def held_of(values: FormData) -> list[HeldIn]:
    """Read the sessions that the form requests; a row without a number of sessions requests none.

    Raises:
        Invalid: what no row of the form sends, or values outside their range.
    """
    units, amplitudes, sessions = ([str(v).strip() for v in values.getlist(f"held_{name}")] for name in ("unit", "amplitude", "sessions"))
    if not len(units) == len(amplitudes) == len(sessions) <= MOST_ROWS or any(unit not in UNITS for unit in units):
        raise Invalid("The held sessions are not those of the form.", "Load the page again.")
    rows = zip(units, amplitudes, sessions, strict=True)
    return [
        parse(HeldIn, {unit: amplitude, "sessions": number}, LABELS, {unit: f"held_amplitude-{k}", "sessions": f"held_sessions-{k}"})
        for k, (unit, amplitude, number) in enumerate(rows)
        if number not in ("", "0")
    ]


def held_rows(values: FormData | None, holds: Sequence[Held], bound: Bound, cdbs_ma: float | None) -> list[HeldRow]:
    """Build the rows of the form: what is suggested, no session requested, and a free row; what was sent where it was refused."""
    unit = "amplitude_ma" if cdbs_ma is not None else "amplitude_fraction"
    rows = [HeldRow(unit, offered(h.hold.fraction, bound, cdbs_ma), "", h) for h in holds]
    rows = [*rows[: MOST_ROWS - 1], HeldRow(unit, "", "")]
    sent = [[str(v) for v in values.getlist(f"held_{name}")] for name in ("amplitude", "sessions")] if values is not None else [[], []]
    if len(sent[0]) != len(rows) or len(sent[1]) != len(rows):
        return rows
    return [HeldRow(row.unit, sent[0][i], sent[1][i], row.why) for i, row in enumerate(rows)]
