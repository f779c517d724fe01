"""When the data give no reason to believe an order of policies."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ml.ope.outcomes.model import fit_end_model
from ml.ope.posterior.held_out import HeldOut
from ml.ope.posterior.skill import ordering_skill
from tests.ml.ope.posterior.known_system import KnownSystem

BUFFER = KnownSystem().buffer()
N = len(BUFFER.sessions)
DOSES = np.array([s.amplitude.mean() for s in BUFFER.sessions])
RNG = np.random.default_rng(0)
OBSERVED = -0.8 + 0.5 * DOSES + 0.05 * RNG.standard_normal(N)


def skill(predicted, levels=None, buffer=BUFFER):
    found = HeldOut({"a": np.zeros(N)}, {"a": np.asarray(predicted)}, OBSERVED, {"a": 1.0})
    return ordering_skill(buffer, found, fit_end_model(buffer), np.zeros(N) if levels is None else levels)


def test_predictions_that_follow_what_happened_are_skill() -> None:
    found = skill(OBSERVED + 0.05 * RNG.standard_normal(N))
    assert (found.told, found.reasons) == (True, ())
    assert found.held_out_correlation > 0.8


def test_a_contrast_between_controllers_with_the_wrong_sign_is_named() -> None:
    found = skill(-0.8 - 0.5 * DOSES)
    assert not found.told
    assert "contrasts_not_reproduced" in found.reasons


def test_levels_of_random_sessions_that_go_with_their_dose_are_named() -> None:
    assert "levels_follow_dose" in skill(OBSERVED, levels=2.0 * DOSES + 0.02 * RNG.standard_normal(N)).reasons
    assert "levels_follow_dose" not in skill(OBSERVED, levels=RNG.standard_normal(N)).reasons


def test_few_sessions_tell_nothing() -> None:
    few = replace(BUFFER, sessions=BUFFER.sessions[:4])
    found = HeldOut({"a": np.zeros(4)}, {"a": OBSERVED[:4]}, OBSERVED[:4], {"a": 1.0})
    assert ordering_skill(few, found, fit_end_model(few), np.zeros(4)).reasons == ("too_few_left_out_sessions",)
