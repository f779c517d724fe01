"""The beta threshold: whether it can be held against a session's beta, in the settings of the MDP, and suggested from what sessions had."""

from __future__ import annotations

from typing import Any

import numpy as np
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.study import blinding, repository
from app.study.settings.service import SuggestedThreshold
from app.study.traces import laid_out, traces_of
from app.tables.participants import Participant, SettingsVersion
from app.tables.recordings import Trace
from app.tables.sessions import Controller


def mismatch(settings: SettingsVersion, trace: Trace | None) -> str:
    """Why a threshold says nothing about a trace of beta; empty where it does, or where there is no threshold or trace.

    Units and sources are never mixed.
    """
    if trace is None or settings.xi_beta is None:
        return ""
    unstated = [name for name, value in (("unit", settings.beta_unit), ("source", settings.beta_source)) if not value]
    if unstated:
        return (
            f"Nobody has stated the {' and the '.join(unstated)} of the threshold of {settings.xi_beta:g}; this trace is in "
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
    """A threshold from the data: midway between the median beta of cDBS sessions and that of no-DBS sessions, else the median of all.

    Of confirmed sessions that are not excluded nor of a blinded plan whose key is sealed, with beta in the settings' unit and from their
    source; None where these leave it open and the sessions have several, which are never mixed.
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
