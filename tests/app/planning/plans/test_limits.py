"""Limits of planned sessions in milliamperes."""

from __future__ import annotations

import pytest

from app.planning.plans.limits import DeviceLimits, SlotLimits, StatedLimits, slot_limits
from app.platform.errors import Invalid
from app.tables.sessions import Controller

NONE = StatedLimits()


@pytest.mark.parametrize(
    ("controller", "least", "device", "expected"),
    [
        (Controller.CDBS, 0.0, None, (3.0, 3.0)),
        (Controller.NO_DBS, 0.0, DeviceLimits(0.5, 4.0), (0.0, 0.0)),
        (Controller.RL, 0.0, None, (0.0, 3.0)),
        (Controller.RL, 0.0, DeviceLimits(0.5, 4.0), (0.5, 3.0)),
        (Controller.RL, 0.55, DeviceLimits(0.5, 4.0), (1.65, 3.0)),
        (Controller.RANDOM, 0.333, None, (1.0, 3.0)),  # 0.999 mA, rounded upwards
    ],
)
def test_defaults(controller: Controller, least: float, device: DeviceLimits | None, expected: tuple[float, float]) -> None:
    assert slot_limits(3.0, controller, 2.0, NONE, device, least) == SlotLimits(3.0, *expected, 1.5)


def test_what_is_stated_holds_and_never_goes_below_what_the_verdict_allows() -> None:
    stated = StatedLimits(1.0, 3.5, 0.25)
    assert slot_limits(3.0, Controller.RL, 2.0, stated, DeviceLimits(0.5, 4.0)) == SlotLimits(3.0, 1.0, 3.5, 0.25)
    assert slot_limits(3.0, Controller.RL, 2.0, stated, None, 0.5).min_ma == 1.5
    assert slot_limits(3.0, Controller.CDBS, 2.0, stated, None) == SlotLimits(3.0, 3.0, 3.0, 0.25)


@pytest.mark.parametrize(
    ("stated", "device", "words"),
    [
        (StatedLimits(max_ma=2.5), None, "leave out the cDBS amplitude of 3 mA"),
        (StatedLimits(min_ma=3.5), None, "leave out the cDBS amplitude of 3 mA"),
        (StatedLimits(min_ma=0.2), DeviceLimits(0.5, 4.0), "leave those of the stimulator, 0.5 to 4 mA"),
        (StatedLimits(max_ma=4.5), DeviceLimits(0.5, 4.0), "leave those of the stimulator, 0.5 to 4 mA"),
        (NONE, DeviceLimits(0.5, 2.0), "leave those of the stimulator, 0.5 to 2 mA"),
    ],
)
def test_limits_that_cannot_be_kept_are_refused(stated: StatedLimits, device: DeviceLimits | None, words: str) -> None:
    with pytest.raises(Invalid, match=words):
        slot_limits(3.0, Controller.RL, 2.0, stated, device)
