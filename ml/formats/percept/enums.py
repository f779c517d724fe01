"""Enumerations of Percept session reports that may be stored: types and values made of a closed list of technical words.

The words are those of the format notes, of real reports and of what public toolboxes compare with. A name of a person is none of them. Of
an enumeration with another word the known words are kept, and the other ones become `…`.
"""

from __future__ import annotations

import re
from functools import lru_cache
from typing import Any

from ml.formats.percept.keys import KEYS

TYPES = frozenset(
    re.findall(
        r"\w+",
        """
        ADBSStatusDef AdaptiveModeDef AmplitudeTypeDef ArtifactStatusDef BatteryStatusDef CyclingStatusDef DeviceStateDef ElectrodeDef
        ElectrodeStateDef EventTypeDef GroupIdDef HemisphereLocationDef ImpedanceStateDef ImpedanceStatusDef InsLocation InsPort
        LeadLocationDef LeadModelDef LimitModeDef LimitTypeDef ParameterTrendIdDef ProgramIdDef RechargeSessionStateDef
        SensingChannelDef SensingElectrodeConfigDef SensingStatusDef SessionStateDef SignalTestResultDef StimStatusDef
        TherapyChangeStatusDef TherapyStatusDef TipOffsetDef
        """,
    )
)

NUMBERS = frozenset(re.findall(r"\w+", "zero one two three four five six seven eight nine ten eleven twelve thirteen fourteen fifteen"))

WORDS = NUMBERS | frozenset(
    re.findall(
        r"\w+",
        """
        aborted abdomen active adaptive adbs advance amplitude and ant artifact bad basic cancelled case changed charge charged charging
        chest complete completed configured critical ct current cycling detected direct disabled dual ecg edit electrode electrodes
        enabled end eos eri error excellent fail failed fair first fourth full gpe gpi good group high idle inactive impedance integrity
        inverse investigate interrupted ipg lead left limit limits low measured motion movement negative no none normal not off ok on
        open other paused performed poor positive present program pulse rate recharge recharging right ring running second segment sen
        sensight session short sight single sqc start status stim stimulation stn stopped suspended therapy third threshold unavailable
        undefined unknown valid vim voltage width
        """,
    )
)
"""In small letters; a value may join them by underscores or by capitals."""

LEAD_MODELS = frozenset({"B33005", "B33015", "3387", "3389", "3391", "3550"})
MAX_WORDS = 9
UNKNOWN = "…"
"""Sign for what is not known to be technical."""

_ENUM = re.compile(r"([A-Za-z…]{3,40})[._]([A-Za-z0-9_…]{1,60})")
_CONTACT = re.compile(r"\d{1,2}[abc]?")
_WORD = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+|…")
_TYPE_WORDS = frozenset(part.lower() for name in (*TYPES, *KEYS) for part in _WORD.findall(name))


def is_known(text: str) -> bool:
    """Decide whether a text is an enumeration that can contain no name, such as `GroupIdDef.GROUP_A` or `ElectrodeDef.SenSight_1a`."""
    match = _ENUM.fullmatch(text)
    return match is not None and mask(text) == text and UNKNOWN not in text


@lru_cache(maxsize=4096)
def mask(text: str) -> str | None:
    """Mask what of an enumeration is not known to be technical: `LeadLocationDef.Ada` is `LeadLocationDef.…`; None for what is none."""
    match = _ENUM.fullmatch(text)
    if match is None:
        return None
    kind, before, count = match[1], "", 0
    kept = kind in TYPES or (kind.endswith("Def") and all(part.lower() in _TYPE_WORDS for part in _parts(kind)))
    pieces = []
    for piece in match[2].split("_"):
        shown: list[str] = []
        parts = _parts(piece)
        for part in parts:
            # a letter names a group, or a segment of a contact
            letter = part in ("A", "B", "C", "D") and (before == "group" or (before in NUMBERS and part != "D"))
            numbered = kind == "ElectrodeDef" and _CONTACT.fullmatch(part) is not None and match[2].endswith(part)
            model = kind == "LeadModelDef" and part in LEAD_MODELS
            count += 1
            good = count <= MAX_WORDS and (part.lower() in WORDS or letter or numbered or model)
            if good or shown[-1:] != [UNKNOWN]:
                shown.append(part if good else UNKNOWN)
            before = part.lower()
        pieces.append("".join(shown))
    value = "_".join(pieces) if any(pieces) else UNKNOWN
    return f"{kind if kept else UNKNOWN + 'Def'}{text[len(kind)]}{value}"


def _parts(piece: str) -> list[str]:
    """Split `SessionStart` into two words; what is not made of letters alone stays whole."""
    found = _WORD.findall(piece)
    return found if "".join(found) == piece else [piece]


def word(value: Any) -> str | None:
    """Return the last part of an enumeration, `GroupIdDef.GROUP_A` or `GroupIdDef_GROUP_A` being `GROUP_A`; None for what is no
    enumeration. What of it is not known to be technical is `…`."""
    shown = mask(value) if isinstance(value, str) and len(value) <= 102 else None
    return re.split(r"[._]", shown, maxsplit=1)[1] if shown else None
