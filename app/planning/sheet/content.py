"""Text of the sheets on a session, printed with its plan and packed into its bundle: made once, so that no two papers disagree."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from app.evaluation.ranking.verdict_wording import STANDING_NAMES, effect, likely, plainly
from app.planning.plans import wording
from app.planning.plans.view import PlanLine, PlanView
from app.planning.sheet.ink import clock, printed_name, printed_warning, shade
from app.tables.sessions import Controller
from ml.outcomes import OUTCOMES

BUNDLE = "Bundle"
HASH = 12
"""Characters of a hash that are printed: enough to distinguish two bundles of a study by eye."""


@dataclass(frozen=True)
class Card:
    """Content of a card.

    Attributes:
        head, minutes: of its title line, left and right. lines: label and text. warnings: a sentence each. fill: colour of the title line.
    """

    head: str
    minutes: str
    lines: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...]
    fill: tuple[int, int, int]


def card_of(line: PlanLine, view: PlanView, bundle: str | None, ports: Mapping[int, str] = {}) -> Card:
    """Build a session's card; of a sealed plan's session, which has lost its controller, only letters and common limits.

    Args:
        bundle: SHA-256 of the newest one taken for the session. ports: checks of converted copies, by the number of the policy.
    """
    item = line.item
    length = f"{item.minutes:g} min"
    for minutes, what in ((item.washout_minutes, "washout"), (item.break_minutes, "break")):
        length += f", then {minutes:g} min {what}" if minutes else ""
    limits = f"{wording.limits_ma(item)} mA" if item.max_ma is not None else "not set"
    limits += f", ramp {item.ramp_ma_per_s:g} mA/s" if item.ramp_ma_per_s is not None else ""
    limits += f", {item.hemisphere} side" if item.hemisphere else ""
    rows = {
        "Policy": printed_name(line.policy) if line.policy else "",
        "Limits": limits,
        "Design": wording.design_name(line.design) if line.design else "",
        BUNDLE: "" if view.sealed else _bundle(line, bundle),
        "Copies": ports.get(line.policy.id, "") if line.policy and not view.sealed else "",
        "Verdict": _verdict(line),
        "Expected": _expected(line),
        "Against cDBS": effect(line.row.differences) if line.row and line.row.differences else "",
        "Medication": f"due before: {item.medication}" if item.medication else "",
    }
    told = wording.plain_warnings(view.warnings)
    warnings = tuple(printed_warning(text, line.policy) for w, text in told if line.policy is not None and w.policy_id == line.policy.id)
    head = f"{item.position}  {clock(line.start_minute, view.plan.starts_at)}  {wording.session_name(item)}"
    return Card(head, length, tuple((label, text) for label, text in rows.items() if text), warnings, shade(line))


def _bundle(line: PlanLine, sha256: str | None) -> str:
    if line.item.controller == Controller.NO_DBS:
        return "none: off, and on again, by the programmer"
    return sha256[:HASH] if sha256 else "not taken yet"


def _verdict(line: PlanLine) -> str:
    """Write the ranking's verdict with its reason and the chance of being no worse than cDBS; empty of what was not ranked."""
    if line.row is None:
        return ""
    why = plainly(line.row.decided.hazards or line.row.decided.reasons, line.row.limit, line.row.limit_ma)
    chance = "" if line.row.within is None else f"; {likely(line.row.within)}"
    return STANDING_NAMES[line.row.decided.standing] + (f": {why}" if why else "") + chance


def _expected(line: PlanLine) -> str:
    """Write what is expected in a session; empty of one that was not ranked, as cDBS, whose energy is 100 % by definition."""
    e = line.estimate
    if e is None:
        return ""
    told = [] if line.predicted_energy is None else [f"energy {100 * line.predicted_energy:.0f} % of cDBS"]
    known = [o for o in OUTCOMES if o.field in e.predicted]
    return ", ".join([*told, *(f"{o.noun} {e.predicted[o.field]:.{o.mean_decimals}f} {o.entry_unit}" for o in known)])
