"""Reasons why a decoder leaves packets out, and the words for them."""

from __future__ import annotations

from enum import StrEnum


class Rejected(StrEnum):
    """Reason why a packet was ignored. The last three are of decode versions up to 4, whose recordings are shown as they were stored."""

    DUPLICATE = "duplicate"
    UNPLACEABLE = "unplaceable"
    DAY_OFF = "day_off"
    CLOCKS_DISAGREE = "clocks_disagree"
    STEPS_BACK = "steps_back"


REJECTED_WORDS = {
    Rejected.DUPLICATE: "the same packet twice, sample by sample",
    Rejected.UNPLACEABLE: "its ticks contradict both clocks",
    Rejected.DAY_OFF: "timestamp more than a day off",
    Rejected.CLOCKS_DISAGREE: "device and PC clock disagree by more than 2 s",
    Rejected.STEPS_BACK: "PacketGenTime steps back",
}
"""Reasons in words."""
