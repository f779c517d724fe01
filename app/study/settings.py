"""Settings of a participant: the form and its page."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any

import numpy as np
from sqlalchemy.exc import IntegrityError
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.platform.database import set_reason
from app.platform.errors import Conflict, Invalid
from app.platform.numbers import number
from app.study import blinding, repository
from app.study.access import require
from app.study.outcome_fields import require_sure
from app.study.settings_types import SettingsIn
from app.study.traces import laid_out, traces_of
from app.tables.participants import Participant, SettingsVersion
from app.tables.recordings import Trace
from app.tables.sessions import Controller
from ml.mdp import MdpSettings

# Rules of a participant's settings: each change is a new version.

SIGNED_UNITS = {"dB", "z"}
"""Units in which a beta may be negative: logarithms and standard scores."""


def change_settings(
    db: Session, participant: Participant, change: SettingsIn, reason: str | None, caller: Caller, sure: Collection[str] | None = None
) -> SettingsVersion:
    """Make a new settings version of what the change names; old results keep theirs. No change, no version.

    Raises Unusual for a value outside the usual whose name is not among `sure`; without a `sure` nothing is asked.
    """
    require(caller, can.WRITE_SETTINGS, participant)
    current = participant.current_settings
    values = {name: getattr(current, name) for name in SettingsIn.model_fields} | change.model_dump(exclude_unset=True)
    if all(getattr(current, name) == value for name, value in values.items()):
        return current
    require_sure(change.model_dump(exclude_unset=True), sure, current)
    return add_settings(db, participant, values, caller, reason)


def add_settings(db: Session, participant: Participant, values: dict[str, Any], caller: Caller, reason: str | None) -> SettingsVersion:
    """Store the next settings version. Raises Invalid for settings that contradict each other, Conflict where another person was faster."""
    try:
        MdpSettings(xi_beta=values["xi_beta"] if values["xi_beta"] is not None else 0.0, **{n: values[n] for n in MDP_FIELDS})
    except ValueError as error:
        raise Invalid(f"{error}.", "Correct the settings.") from error
    xi_beta, unit = values["xi_beta"], values["beta_unit"]
    if xi_beta is not None and xi_beta <= 0 and unit not in SIGNED_UNITS:
        raise Invalid(
            f"A beta threshold of {xi_beta:g} {unit or ''} cannot be: an amplitude or a power is positive.".replace("  ", " "),
            f"Give one above 0, or state the unit of a beta that may be negative: {', '.join(sorted(SIGNED_UNITS))}.",
        )
    if values["beta_low_hz"] >= values["beta_high_hz"]:
        raise Invalid(
            f"The beta band {values['beta_low_hz']:g}-{values['beta_high_hz']:g} Hz is empty.", "Set beta_low_hz below beta_high_hz."
        )
    row = SettingsVersion(
        participant_id=participant.id, version=len(participant.settings) + 1, created_by=caller.label, reason=reason, **values
    )
    set_reason(db, reason)
    participant.settings.append(row)
    try:
        db.flush()
    except IntegrityError as error:
        db.rollback()
        raise Conflict("Another person changed these settings at the same time.", "Load them again and repeat your change.") from error
    return row


MDP_FIELDS = (
    "window", "period_s", "r_a", "r_b", "c1", "c2", "c3", "c4", "gamma", "lower_bound", "tremor_as_fraction",
)  # fmt: skip


@dataclass(frozen=True)
class SuggestedThreshold:
    """A threshold from the data, in the unit and from the source of the beta that it was taken from."""

    value: float
    unit: str
    source: str


def mdp_settings(settings: SettingsVersion, suggestion: SuggestedThreshold | None = None) -> MdpSettings:
    """Build the MDP of a settings version.

    Raises:
        Invalid: xi_beta is not set; names the suggestion from the data where there is one.
    """
    if settings.xi_beta is None:
        hint = f" A suggestion from the data: {number(suggestion.value, 4)} {suggestion.unit}." if suggestion is not None else ""
        raise Invalid(
            f"Participant {settings.participant.code} has no beta threshold xi_beta yet; the paper gives no default.",
            f"Set xi_beta in the participant's settings.{hint}",
            suggested_xi_beta=suggestion.value if suggestion else None,
        )
    return MdpSettings(xi_beta=settings.xi_beta, **{name: getattr(settings, name) for name in MDP_FIELDS})


# The beta threshold: whether it can be compared with a session's beta, in the settings of the MDP, and suggested from what sessions had.


def mismatch(settings: SettingsVersion, trace: Trace | None) -> str:
    """Explain why a threshold does not apply to a trace of beta; empty where it does, or where there is no threshold or trace.

    Units and sources are never mixed.
    """
    if trace is None or settings.xi_beta is None:
        return ""
    unstated = [name for name, value in (("unit", settings.beta_unit), ("source", settings.beta_source)) if not value]
    if unstated:
        return (
            f"No person has stated the {' and the '.join(unstated)} of the threshold of {settings.xi_beta:g}; this trace is in "
            f"{trace.unit} from {trace.source}. State unit and source in the participant's settings."
        )
    wanted = (settings.beta_unit, settings.beta_source)
    if (trace.unit, trace.source) == wanted:
        return ""
    return (
        f"The threshold of {settings.xi_beta:g} is in {wanted[0]} from {wanted[1]}; this trace is in {trace.unit} from {trace.source}. "
        "They are not comparable."
    )


def suggest_xi_beta(db: Session, participant: Participant, caller: Caller) -> SuggestedThreshold | None:
    """Suggest a threshold from the data: midway between the median beta of cDBS sessions and that of no-DBS sessions, else the median of
    all.

    Used are confirmed sessions that are neither excluded nor sealed, with beta in the settings' unit and from their source. None where
    these leave it open and the sessions have several, which are never mixed.
    """
    settings = participant.current_settings
    groups: dict[Controller, list[np.ndarray[Any, Any]]] = {}
    kinds: set[tuple[str, str]] = set()
    sessions = repository.sessions_of_participant(db, participant.id)
    traces = traces_of(db, sessions)
    for session in sessions:
        if session.visit.sealed:
            continue
        table = laid_out(session, settings, traces)
        trace = table.beta_trace
        if session.excluded_reason or trace is None:
            continue
        if (settings.beta_unit or trace.unit, settings.beta_source or trace.source) != (trace.unit, trace.source):
            continue
        kinds.add((trace.unit, trace.source))
        groups.setdefault(blinding.arm(session, caller).controller, []).append(table.beta[~np.isnan(table.beta)])
    medians = {c: float(np.median(np.concatenate(b))) for c, b in groups.items() if sum(x.size for x in b)}
    if len(kinds) != 1 or not medians:
        return None
    unit, source = kinds.pop()
    if Controller.CDBS in medians and Controller.NO_DBS in medians:
        return SuggestedThreshold((medians[Controller.CDBS] + medians[Controller.NO_DBS]) / 2, unit, source)
    return SuggestedThreshold(float(np.median(np.concatenate([x for parts in groups.values() for x in parts if x.size]))), unit, source)
