"""Enumerations of Percept session reports that may be stored: known types, and values made of a closed list of technical words.

The words are those of the format notes, of real reports and of what public toolboxes compare with. A name of a person is none of them.
"""

from __future__ import annotations

import re
from typing import Any

TYPES = frozenset(
    re.findall(
        r"\w+",
        """
        ADBSStatusDef AdaptiveModeDef AmplitudeTypeDef ArtifactStatusDef BatteryStatusDef CyclingStatusDef DeviceStateDef ElectrodeDef
        ElectrodeStateDef EventTypeDef GroupIdDef HemisphereLocationDef ImpedanceStateDef ImpedanceStatusDef InsLocation InsPort
        LeadLocationDef LeadModelDef LimitModeDef LimitTypeDef ParameterTrendIdDef ProgramIdDef SensingChannelDef
        SensingElectrodeConfigDef SensingStatusDef SessionStateDef SignalTestResultDef StimStatusDef TherapyStatusDef TipOffsetDef
        """,
    )
)

NUMBERS = frozenset(re.findall(r"\w+", "zero one two three four five six seven eight nine ten eleven twelve thirteen fourteen fifteen"))

WORDS = NUMBERS | frozenset(
    re.findall(
        r"\w+",
        """
        abdomen adaptive adbs advance amplitude and ant artifact basic case changed chest configured ct current cycling detected
        direct disabled dual ecg edit electrode electrodes enabled end eos eri error fail failed first fourth gpe gpi group high
        impedance integrity inverse investigate ipg lead left limit limits low measured motion movement negative no none normal not
        off ok on open other paused performed positive present program pulse rate right ring running second segment sen sensight
        session short sight single sqc start status stim stimulation stn stopped suspended therapy third threshold unavailable
        undefined unknown valid vim voltage width
        """,
    )
)
"""In small letters; a value may join them by underscores or by capitals."""

LEAD_MODELS = frozenset({"B33005", "B33015", "3387", "3389", "3391", "3550"})
MAX_WORDS = 9
_ENUM = re.compile(r"([A-Za-z]{3,40})[._]([A-Za-z0-9_]{1,60})")
_CONTACT = re.compile(r"\d{1,2}[abc]?")
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")


def is_known(text: str) -> bool:
    """Decide whether a text is an enumeration that can contain no name, such as `GroupIdDef.GROUP_A` or `ElectrodeDef.SenSight_1a`."""
    match = _ENUM.fullmatch(text)
    if match is None or match[1] not in TYPES:
        return False
    before = ""
    parts = [part for piece in match[2].split("_") for part in _parts(piece)]
    for part in parts:
        # a letter names a group, or a segment of a contact
        letter = part in ("A", "B", "C", "D") and (before == "group" or (before in NUMBERS and part != "D"))
        numbered = match[1] == "ElectrodeDef" and _CONTACT.fullmatch(part) is not None and part == parts[-1]
        model = match[1] == "LeadModelDef" and part in LEAD_MODELS
        if not (part.lower() in WORDS or letter or numbered or model):
            return False
        before = part.lower()
    return 0 < len(parts) <= MAX_WORDS


def _parts(piece: str) -> list[str]:
    """Split `SessionStart` into two words; what is not made of letters alone stays whole."""
    found = _WORD.findall(piece)
    return found if "".join(found) == piece and piece else [piece]


_LAST_PART = re.compile(r"[A-Za-z]{1,40}[._]([A-Za-z0-9_]{1,60})")


def word(value: Any) -> str | None:
    """Return the last part of an enumeration, `GroupIdDef.GROUP_A` or `GroupIdDef_GROUP_A` being `GROUP_A`; None for what is no
    enumeration."""
    match = _LAST_PART.fullmatch(value) if isinstance(value, str) else None
    return match[1] if match else None
