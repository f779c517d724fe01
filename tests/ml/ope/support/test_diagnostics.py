from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from ml.ope.support.diagnostics import FAR_SHARE, LEAVES_SHARE, diagnose
from ml.policies.policy import ConstantPolicy, ProportionalPolicy


@pytest.fixture(scope="module")
def seen(linear_simulator):
    buffer = linear_simulator.buffer(seed=0)
    policies = {
        "none": ConstantPolicy(0.0),
        "half": ConstantPolicy(0.55),
        "adaptive": ProportionalPolicy(0.6, 1.1, 0.35, 3),
        "low": ConstantPolicy(0.25),
    }
    return diagnose(buffer, policies)


def test_a_policy_that_leaves_the_logged_amplitudes_fails_that_check_by_name(seen):
    assert not seen["none"].supported
    refusal = seen["none"].failing[0]
    assert (refusal.code, refusal.limit, refusal.refuses) == ("outside_range", 0.2, True)
    assert (refusal.fact("low"), refusal.fact("high")) == pytest.approx((0.3, 1.0), abs=0.005)
    assert seen["none"].below_random_bound == 1.0


def test_a_policy_among_the_data_is_supported_though_its_weights_are_not(seen):
    for name in ("half", "adaptive"):
        assert seen[name].supported
        few = seen[name].weights_failing[0]
        assert (few.code, few.fact("sessions"), few.refuses) == ("weights_need_sessions", 20, False)
        assert seen[name].effective_sessions < 10
        assert seen[name].horizon_of_ten < 50
        assert seen[name].below_random_bound == 0.0


def test_pairs_off_the_data_are_further_than_pairs_among_them(seen):
    assert seen["none"].distance > 3 * seen["half"].distance
    assert seen["half"].far < 0.05 < seen["none"].far


def test_the_policy_that_made_the_data_is_as_near_as_the_data_are_to_themselves(linear_simulator):
    buffer = linear_simulator.buffer(seed=0)
    rng = np.random.default_rng(1)

    class Logged:
        def act(self, states):
            return rng.uniform(0.3, 1.0, len(states))

    found = diagnose(buffer, {"random": Logged()})["random"]
    assert found.distance < 0.6
    assert found.far < 0.05
    assert found.supported
    json.dumps(found.to_json())


def test_a_lasting_low_amplitude_is_unseen_where_random_sessions_only_passed_through_it(linear_simulator):
    buffer = linear_simulator.buffer(seed=0)
    random = replace(buffer, sessions=tuple(s for s in buffer.sessions if s.controller == "random"))
    found = diagnose(random, {"low": ConstantPolicy(0.4), "middle": ConstantPolicy(0.65)})
    assert found["low"].amplitudes.supported
    assert found["low"].unseen_dose > 0.9
    assert [note.code for note in found["low"].notes] == ["unseen_dose"]
    assert found["middle"].notes == ()


def test_every_check_has_its_limit_and_only_refusals_make_a_policy_unsupported(seen):
    for found in seen.values():
        checks = {c.name: c for c in found.checks}
        assert len(checks) == len(found.checks) == 9
        assert found.supported == all(c.verdict != "refused" for c in found.checks)
        for c in found.checks:
            if c.limit is None or c.value is None:
                assert c.verdict == "told"
            else:
                within = c.value >= c.limit if c.at_least else c.value <= c.limit
                # of the two limits of thinly covered amplitudes the stricter one only notes
                assert (c.verdict == "passed") == (within and not (c.name == "thin" and c.value > 0.05))
    off = {c.name: c for c in seen["none"].checks}
    assert (off["outside_range"].value, off["outside_range"].limit, off["outside_range"].verdict) == (1.0, LEAVES_SHARE, "refused")
    assert (off["far"].limit, off["far"].verdict) == (FAR_SHARE, "refused")
    half = {c.name: c for c in seen["half"].checks}
    assert {half[n].verdict for n in ("effective_sessions", "horizon_of_ten")} == {"weights"}
    assert half["effective_sessions"].at_least
    assert (half["horizon_of_ten"].limit, seen["half"].sessions) == (seen["half"].horizon_steps, 20)


def test_amplitudes_below_the_random_controllers_are_noted_with_the_bound(seen):
    assert seen["low"].below_random_bound == 1.0
    bounds = [note.fact("bound") for note in seen["low"].notes if note.code == "below_random_bound"]
    assert bounds == [pytest.approx(0.3)]
    assert not any(note.code == "below_random_bound" for note in seen["half"].notes)


def test_without_random_sessions_the_share_below_their_bound_is_not_known(linear_simulator):
    buffer = linear_simulator.buffer(seed=0)
    others = replace(buffer, sessions=tuple(s for s in buffer.sessions if s.controller != "random"))
    found = diagnose(others, {"half": ConstantPolicy(0.55)})["half"]
    check = next(c for c in found.checks if c.name == "below_random_bound")
    assert (check.value, check.verdict, found.random_bound) == (None, "told", None)
