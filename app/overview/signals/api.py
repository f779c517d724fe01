"""Samples of a session at the resolution of a screen."""

from __future__ import annotations

from typing import Annotated

from fastapi import APIRouter, Query

from app.accounts.deps import CurrentCaller
from app.overview.signals.schemas import ChannelNumber, SignalOut, Time
from app.overview.signals.serializers import signal_out
from app.overview.signals.service import signals_of
from app.platform.database import Db
from app.platform.web.schemas import problems
from app.study.deps import CurrentSession, SessionViewed

router = APIRouter(tags=["study"], responses=problems(401, 403, 404, 409, 422))

Points = Annotated[int, Query(ge=50, le=4000, description="Bins wanted; there are at most four times as many.")]


@router.get("/sessions/{session_id}/signal", dependencies=[SessionViewed])
def read_signal(
    session: CurrentSession,
    db: Db,
    caller: CurrentCaller,
    channel: ChannelNumber = 0,
    begin_s: Time = None,
    end_s: Time = None,
    points: Points = 1000,
) -> SignalOut:
    """A channel of raw samples between two times: extremes per bin (every sample, where there are few), and the spectrogram.

    The first request for a session decodes its files, which may take seconds; what was made of them is kept.
    """
    signals = signals_of(db, session, caller)
    return signal_out(signals, signals.window(channel, begin_s, end_s, points))
