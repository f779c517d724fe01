"""Settings of a Percept by which the delivered amplitude differs from the stated one, and the place of its leads."""

from __future__ import annotations

from datetime import datetime
from typing import Any

from ml.formats.percept.enums import word
from ml.formats.percept.report_json import entries, finite, inside, moment, side_of

_SPELLINGS = {"GPI": "GPi", "GPE": "GPe"}
LOGGED_WITHIN_S = 5.0
"""The device's log and its packets are dated to the second; a change this near to a run counts as within it."""

_ON = frozenset({"on", "enabled", "true"})


def cycling(report: dict[str, Any], group: str | None) -> dict[str, Any] | None:
    """Find the cycling of a therapy group.

    Args:
        report: as it was read.
        group: such as `A`; None: the active one.

    Returns:
        `enabled`, and `on_s`, `off_s` where the report has them. None where the report does not state whether the group cycles. Where its
        begin and its end differ, cycling counts.
    """
    stated = []
    for part in ("Initial", "Final"):
        for one in entries(inside(report, "Groups", part)):
            letter = (word(one.get("GroupId")) or "").removeprefix("GROUP_")
            if (letter == group) if group else one.get("ActiveGroup") is True:
                stated.append(inside(one, "GroupSettings", "Cycling"))
    found = [c for c in map(_cycling, stated) if c is not None]
    return next((c for c in found if c["enabled"]), found[0] if found else None)


def groups_used(report: dict[str, Any], group: str | None, began: datetime | None, length_s: float) -> list[str | None]:
    """List the groups that were active in a run: that of its snapshot, and those of changes in the device's log.

    Args:
        report: as it was read.
        group: of the run's snapshot. began: first packet of the run, on the implant's clock as the log is. length_s: of the run.
    """
    found = [group]
    for event in entries(inside(report, "DiagnosticData", "EventLogs")):
        when = moment(event.get("DateTime"))
        if began is None or when is None or not -LOGGED_WITHIN_S <= (when - began).total_seconds() <= length_s + LOGGED_WITHIN_S:
            continue
        for key in ("OldGroupId", "NewGroupId"):
            if named := (word(event.get(key)) or "").removeprefix("GROUP_"):
                found.append(named)
    return list(dict.fromkeys(found))


def _cycling(value: Any) -> dict[str, Any] | None:
    state = value.get("Enabled", value.get("CyclingStatus")) if isinstance(value, dict) else value
    if isinstance(state, bool):
        enabled = state
    elif (named := (word(state) or (state if isinstance(state, str) else ""))) != "":
        enabled = named.lower() in _ON
    else:
        return None
    if not isinstance(value, dict) or not enabled:
        return {"enabled": enabled}
    return {"enabled": True, "on_s": _duration_s(value, "on"), "off_s": _duration_s(value, "off")}


def _duration_s(value: dict[str, Any], state: str) -> float | None:
    """Read how long one state of the cycle lasts, s, whatever unit its key names."""
    for key, held in value.items():
        name, number = key.lower(), finite(held)
        if number is not None and name.startswith((state, f"cycling{state}", f"cycle{state}")) and number > 0:
            scale = 1e-3 if "milli" in name else 60.0 if "minute" in name else 1.0
            return number * scale
    return None


def describe_cycling(state: dict[str, Any], group: str | None) -> str:
    """Describe why the amplitude of a run is unknown."""
    on_s, off_s = state.get("on_s"), state.get("off_s")
    length = f" ({on_s:g} s on, {off_s:g} s off)" if on_s and off_s else ""
    return (
        f"group {group or 'in use'} cycles its stimulation{length}: the stated amplitude was not delivered all the time, and the report "
        "does not say when. The amplitude is unknown"
    )


def leads_of(report: dict[str, Any]) -> dict[str, str]:
    """Find the lead of each side and its target, such as `left STN`."""
    out: dict[str, str] = {}
    for part in ("Initial", "Final"):
        for lead in entries(inside(report, "LeadConfiguration", part)):
            side, place = side_of(word(lead.get("Hemisphere"))), word(lead.get("LeadLocation"))
            if side and place and place.isalpha() and place.upper() not in ("OTHER", "UNKNOWN", "UNDEFINED", "NONE"):
                out[side] = f"{side} {_SPELLINGS.get(place.upper(), place.upper())}"
    return out
