from __future__ import annotations

from ml.ope.compare.selection import Gain, surest


def test_the_surest_gain_is_chosen_and_not_the_largest():
    lucky, sure = Gain(9.0, -3.0, 7.0), Gain(2.0, 1.0, 0.5)
    assert surest({"lucky": lucky, "sure": sure}) == "sure"
    assert surest({"lucky": lucky}) is None
    assert surest({"level": Gain(0.0, 0.0, 0.0)}) is None, "cDBS is not above itself"
    assert surest({}) is None
