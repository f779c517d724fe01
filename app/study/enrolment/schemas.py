"""API type of an enrolment."""

from __future__ import annotations

from typing import Literal

from pydantic import Field

from app.platform.web.schemas import Bool, Model, Text
from app.study.schemas import Code
from app.study.settings.schemas import SettingsIn
from app.study.usual.values import SURE


class ParticipantIn(Model):
    """A participant to enrol."""

    code: Code
    is_study_code: Bool = Field(
        False, description="A person has looked at a code that resembles a name or holds a birth year or date: it is a study code."
    )
    site: Text | None = Field(
        None, max_length=81, description="Code of the site; needed when there are several. `STUDY/SITE` where two studies share a code."
    )
    settings: SettingsIn = Field(default_factory=SettingsIn)
    sure: list[Literal["cdbs_amplitude_ma"]] | None = Field(None, max_length=1, description=SURE)
