"""API types of samples at the resolution of a screen."""

from __future__ import annotations

from typing import Annotated

from fastapi import Query
from pydantic import Field

from app.platform.web.schemas import Model

ChannelNumber = Annotated[int, Query(ge=0, le=1000, description="A channel's place in the session, from 0.")]
Time = Annotated[float | None, Query(ge=-1e6, le=1e6, allow_inf_nan=False, description="Seconds from the session's start.")]


class SignalChannelOut(Model):
    """One channel of a recording within a session."""

    number: int = Field(description="Its place in the session, from 0.")
    recording: int
    hemisphere: str | None
    channel: str
    unit: str
    rates_hz: list[float]
    samples: int
    begin_s: float = Field(description="First sample, seconds from the session's start.")
    end_s: float


class SpectrogramOut(Model):
    """Power over time and frequency: Hann segments of 1 s that overlap by half, averaged per column."""

    first_s: float = Field(description="Where column 0 begins, seconds from the session's start.")
    width_s: float = Field(description="Seconds of a column.")
    hz: list[float]
    decibel: list[list[float | None]] = Field(
        description="A list per column: 10 log10 of the density in the samples' unit squared per Hz; null without a whole segment."
    )


class SignalOut(Model):
    """A channel between two times: extremes per bin, or every sample where there are few."""

    channels: list[SignalChannelOut] = Field(description="All channels of the session.")
    channel: int
    begin_s: float
    end_s: float
    resolution_s: float = Field(description="Width of a bin; 0 where every sample stands.")
    t_s: list[float] = Field(description="Middle of each bin, or time of each sample, seconds from the session's start.")
    low: list[float | None] = Field(description="Lowest sample of each bin; null where samples are missing.")
    high: list[float | None]
    spectrogram: SpectrogramOut
