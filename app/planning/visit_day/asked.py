"""Entries of a clinic day about the outcomes of a session: their types, and one record for each outcome that is asked for."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import Annotated, Any, Literal
from uuid import UUID

import numpy as np
from pydantic import AfterValidator, Field, Strict, model_validator

from app.platform.web.schemas import Int, Model, Number
from ml.qoc import grasp_frequency

MOST_TAPS = 200
_LONGEST_OFFSET_MS = 10**13  # a tablet whose battery was empty may wake in 1970, and what it holds must be taken all the same


def _utc(value: datetime) -> datetime:
    value = value.replace(tzinfo=UTC) if value.tzinfo is None else value
    if not 1970 <= value.year <= 2200:
        raise ValueError("the year must lie between 1970 and 2200")
    return value.astimezone(UTC)


DeviceTime = Annotated[datetime, AfterValidator(_utc)]


class EntryBase(Model):
    """What every entry has."""

    uuid: UUID = Field(description="Drawn by the tablet; the same one again is the same entry.")
    plan_item_id: Annotated[Int, Field(ge=1)] | None = Field(None, description="Session of the plan; null for the day as a whole.")
    attempt: Annotated[Int, Field(ge=1, le=20)] | None = Field(None, description="1, and one more after every repeat.")
    replaces: list[UUID] = Field(default_factory=list, max_length=20, description="Entries that this one corrects.")
    device_time: DeviceTime
    clock_offset_ms: Annotated[int, Strict(), Field(ge=-_LONGEST_OFFSET_MS, le=_LONGEST_OFFSET_MS)] | None = Field(
        None, description="Service's clock less the tablet's, as last measured."
    )


class SessionEntry(EntryBase):
    """What belongs to one session of the plan."""

    plan_item_id: Annotated[Int, Field(ge=1)]
    attempt: Annotated[Int, Field(ge=1, le=20)] = 1


class RatingPayload(Model):
    """The participant's rating."""

    value: Int = Field(ge=1, le=10)


class GraspPayload(Model):
    """A grasp test: counted by taps, or a number that was read elsewhere."""

    method: Literal["taps", "typed"]
    hz: Number | None = Field(None, ge=0, lt=20, description="As typed; of taps it is computed from them.")
    taps_s: list[Annotated[float, Field(ge=0, le=60, allow_inf_nan=False)]] = Field(
        default_factory=list, max_length=MOST_TAPS, description="Time of each open fist, s after `began_at`."
    )
    began_at: DeviceTime | None = Field(None, description="First moment of the count, by the tablet's clock.")
    ended_at: DeviceTime | None = Field(None, description="Its last moment.")

    @model_validator(mode="after")
    def _whole(self) -> GraspPayload:
        if self.method == "typed":
            if self.hz is None or self.taps_s:
                raise ValueError("a typed grasp frequency has `hz` and no taps")
        elif self.hz is not None or len(self.taps_s) < 2 or self.began_at is None or self.ended_at is None:
            raise ValueError("a counted grasp test has two taps at least, `began_at`, `ended_at` and no `hz`")
        elif any(later <= earlier for earlier, later in itertools.pairwise(self.taps_s)):
            raise ValueError("the taps must follow one another")
        return self


class RatingEntry(SessionEntry):
    """The participant's rating of a session."""

    kind: Literal["rating"]
    payload: RatingPayload


class GraspEntry(SessionEntry):
    """The grasp test of a session."""

    kind: Literal["grasp"]
    payload: GraspPayload


@dataclass(frozen=True, kw_only=True)
class Asked:
    """An outcome that the clinic day asks for after a session.

    Attributes:
        kind: of its entries. field: of `Outcome.field`. payload: of its entries. form: fields that the plain form adds.
        labels: of the form's fields.
        one, several: its entries in words. unit: after a value in a sentence.
        value: of a payload, in the outcome's unit. decimals: of a value in a list of entries; None where it is shown as entered.
    """

    kind: str
    field: str
    payload: type[Model]
    form: Mapping[str, str]
    labels: Mapping[str, str]
    one: str
    several: str
    unit: str
    value: Callable[[Mapping[str, Any]], float]
    decimals: int | None = None

    def words(self, payload: Mapping[str, Any]) -> str:
        """Return the value of a payload in words."""
        value = self.value(payload)
        return str(value) if self.decimals is None else f"{value:.{self.decimals}f}{self.unit}"


def _grasp_hz(payload: Mapping[str, Any]) -> float:
    """Compute the grasp frequency of a test, Hz (eq:grasp_speed)."""
    if payload["method"] == "typed":
        return float(payload["hz"])
    return grasp_frequency(np.asarray(payload["taps_s"], dtype=np.float64))


ASKED = (
    Asked(
        kind="rating",
        field="rating",
        payload=RatingPayload,
        form={},
        labels={"value": "Rating"},
        one="a rating",
        several="ratings",
        unit="",
        value=lambda payload: payload["value"],
    ),
    Asked(
        kind="grasp",
        field="grasp_hz",
        payload=GraspPayload,
        form={"method": "typed"},
        labels={"hz": "Grasp frequency"},
        one="a grasp test",
        several="grasp tests",
        unit=" Hz",
        value=_grasp_hz,
        decimals=2,
    ),
)
ASKED_BY_KIND: Mapping[str, Asked] = {one.kind: one for one in ASKED}
