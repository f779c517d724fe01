"""Members are checked against how beta moves with the dose within random sessions, and those that move it the other way are excluded."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from app.evaluation.wording import sentence
from ml.mdp import MdpSettings
from ml.ope.dlsm.batches import make_batch
from ml.ope.dlsm.config import DlsmConfig
from ml.ope.dlsm.dose_answer import DoseAnswer, answer_of_data, answer_of_member, judge
from ml.ope.dlsm.estimator import Dlsm, FittedDlsm
from ml.ope.dlsm.held_out import BLOCK, SessionError, dose_slopes, shares
from ml.ope.dlsm.linear_part import LinearPart
from ml.ope.dlsm.networks import DlsmNetworks
from ml.ope.doses import memories
from ml.ope.scale import learn_scale
from ml.policies.policy import ConstantPolicy
from ml.qoc import Qoc
from ml.trajectories import ReplayBuffer, SessionTrajectory

TINY: dict[str, Any] = {
    "latent": 2, "hidden": 4, "heads": (4,), "members": 2, "steps": 1, "learning_rate": 1e-9, "batch": 4, "check_every": 1, "rollouts": 12,
    "replay_draws": 3,
}  # fmt: skip
UNLEARNT = DlsmConfig(**TINY, residual=True, reward_terms=False, discard=True)


def held_doses(slope: float, n: int = 8, controller: str = "random", steps: int = 240, noise: float = 0.1) -> ReplayBuffer:
    """Simulate sessions whose doses last 30 s and are answered by beta within a few steps: from no stimulation to cDBS it changes by
    `slope`.
    """
    rng, sessions = np.random.default_rng(4), []
    for k in range(n):
        a = np.repeat(rng.uniform(0.3, 1.0, steps // 15), 15)
        beta, level = np.empty(10 + steps), 0.0
        for t in range(10 + steps):
            level = 0.5 * level + 0.5 * slope * a[max(t - 10, 0)]
            beta[t] = 5.0 + 0.3 * (k % 3) + level + noise * rng.standard_normal()
        qoc = Qoc(grasp_hz=2.0, rating=7, tremor_percent=10.0)
        sessions.append(SessionTrajectory(k, 1 + k // 4, controller, beta[:10], beta[10:], a, qoc, random_bound=0.3))
    return ReplayBuffer(MdpSettings(xi_beta=5.0), tuple(sessions), "uV", "table")


def fitted(buffer: ReplayBuffer, **settings: Any) -> FittedDlsm:
    return Dlsm(replace(UNLEARNT, **settings)).fit(buffer)


def test_the_slope_over_blocks_is_that_of_the_line_and_the_level_cancels() -> None:
    actions = np.repeat([0.4, 0.9, 0.6, 1.0], BLOCK)
    dose, usable = memories(actions)[:, 1], np.ones(4 * BLOCK, bool)
    spread, *slopes = dose_slopes(actions, usable, 2 - 3 * dose, 50 + 0.5 * dose)
    assert slopes == pytest.approx([-3.0, 0.5])
    blocks = dose.reshape(4, BLOCK).mean(1)
    assert spread == pytest.approx(((blocks - blocks.mean()) ** 2).sum())
    gap = usable.copy()
    gap[BLOCK : 2 * BLOCK - 5] = False  # of a block with five known steps nothing is taken
    garbled = np.where(gap, 2 - 3 * dose, 1e6)
    garbled[2 * BLOCK - 5 : 2 * BLOCK] = 1e6
    assert dose_slopes(actions, gap, garbled)[1] == pytest.approx(-3.0)


@pytest.mark.parametrize(("actions", "usable"), [(np.full(120, 0.7), 120), (np.repeat([0.4, 0.9], BLOCK), 60)])
def test_a_session_of_one_dose_or_of_two_blocks_tells_nothing(actions: Any, usable: int) -> None:
    assert dose_slopes(actions, np.ones(usable, bool), np.arange(float(usable))) == (0.0, 0.0)


def test_held_out_checks_see_how_beta_moves_with_the_dose() -> None:
    def one(predicted: float) -> float | None:
        error = SessionError(0, 0.1, 0.1, 0.1, 1.0, 1.0, None, None, 0.0, 0.0, 2.0, -1.0, predicted)
        return shares([[error]]).dose

    assert [one(p) for p in (-1.0, 0.0, 1.0, -0.5)] == pytest.approx([0.0, 1.0, 4.0, 0.25])
    assert shares([[SessionError(0, 0.1, 0.1, 0.1, 1.0, 1.0, None, None, 0.0, 0.0)]]).dose is None
    error = SessionError(0, 0.2, 0.2, 0.2, 1.0, 1.0, None, None, 0.0, 0.0, 2.0, -1.0, 0.0)
    assert shares([[error]]).score == pytest.approx((0.2 + 0.2 + 1.0) / 3)


def test_the_answer_of_the_data_is_the_slope_that_made_them_and_is_told() -> None:
    buffer = held_doses(-2.0)
    scale = learn_scale(buffer)
    found = answer_of_data(make_batch(buffer, scale))
    per_unit = found.slope * scale.beta_std * (5.3 if scale.log else 1.0)
    assert per_unit == pytest.approx(-2.0, rel=0.35)
    assert found.told
    assert found.sessions == 8
    assert not answer_of_data(make_batch(held_doses(0.0), learn_scale(held_doses(0.0)))).told


def test_sessions_of_a_controller_that_may_follow_beta_do_not_count() -> None:
    buffer = held_doses(-2.0, controller="rl")
    found = answer_of_data(make_batch(buffer, learn_scale(buffer)))
    assert (found.sessions, found.told) == (0, False)


@pytest.mark.parametrize("slope", [-2.0, 1.0])
def test_a_linear_part_that_was_fitted_to_the_data_answers_as_they_do(slope: float) -> None:
    buffer = held_doses(slope)
    judged = fitted(buffer).judged
    assert judged is not None
    assert judged.discarded == ()
    assert np.sign(judged.members).tolist() == [np.sign(slope)] * 2
    assert judged.members == pytest.approx([judged.data.slope] * 2, rel=0.35)


def test_the_answer_of_a_member_is_that_of_its_linear_part_while_its_heads_have_learnt_nothing() -> None:
    buffer = held_doses(-2.0)
    scale = learn_scale(buffer)
    part = LinearPart.fit(buffer, scale, range(8))
    networks = DlsmNetworks(10, UNLEARNT)
    networks.linear = part
    networks.start_at_zero()
    rests = [part.resting(np.full((200, 8), a), part.before)[-1].mean() for a in (0.5, 0.9)]
    found = answer_of_member(networks, make_batch(buffer, scale), 0.5, 0.9, 0)
    assert found == pytest.approx((rests[1] - rests[0]) / 0.4, rel=0.15)


@pytest.mark.parametrize(("factor", "kept"), [(-1.0, 2), (0.02, 2), (0.6, 3)])
def test_a_member_whose_answer_is_null_or_wrong_signed_is_discarded_and_said_so(
    factor: float, kept: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    buffer = held_doses(-2.0)
    fit = LinearPart.fit
    calls = iter((1.0, 1.0, factor))

    def one_turned(*given: Any) -> LinearPart:
        part = fit(*given)
        return replace(part, answer=part.answer * next(calls))

    monkeypatch.setattr(LinearPart, "fit", one_turned)
    found = fitted(buffer, members=3)
    assert len(found.members) == kept
    estimate = found.evaluate({"half": ConstantPolicy(0.5)}, 20)["half"]
    assert len(estimate.details["members"]) == kept
    flags = {f.code: f for f in estimate.flags}
    assert ("members_discarded" in flags) == (kept == 2)
    if kept == 2:
        assert (flags["members_discarded"].value, flags["members_discarded"].limit) == (1.0, 3.0)
        assert sentence(flags["members_discarded"]).startswith("1 of 3 models of the ensemble were left out")
        assert estimate.details["dose_answer"]["discarded"] == [2]


def test_one_member_alone_has_no_spread_and_gives_no_estimate(monkeypatch: pytest.MonkeyPatch) -> None:
    fit = LinearPart.fit
    calls = iter((1.0, -1.0))

    def one_turned(*given: Any) -> LinearPart:
        part = fit(*given)
        return replace(part, answer=part.answer * next(calls))

    monkeypatch.setattr(LinearPart, "fit", one_turned)
    with pytest.raises(ValueError, match="no two members of the DLSM answer"):
        fitted(held_doses(-2.0))


def test_few_sessions_or_one_dose_tell_nothing() -> None:
    assert DoseAnswer(-1.0, 0.3, 8, 0.4, 0.9).told
    assert not DoseAnswer(-1.0, 0.4, 4, 0.4, 0.9).told, "t with three degrees of freedom asks for 3.2 standard errors"
    assert not DoseAnswer(-1.0, 0.1, 8, 0.7, 0.7).told, "members cannot be asked between a dose and itself"


def test_where_all_are_discarded_there_is_no_estimate_and_the_reason_has_the_numbers(monkeypatch: pytest.MonkeyPatch) -> None:
    fit = LinearPart.fit
    monkeypatch.setattr(LinearPart, "fit", lambda *given: replace(fit(*given), answer=-fit(*given).answer))
    with pytest.raises(ValueError, match="no two members of the DLSM answer to a lasting dose as the data do: within 8 random sessions"):
        fitted(held_doses(-2.0))
    assert len(fitted(held_doses(-2.0), discard=False).members) == 2


def test_where_the_data_tell_nothing_nobody_is_judged() -> None:
    told, untold = DoseAnswer(-1.0, 0.1, 8, 0.4, 0.9), DoseAnswer(-1.0, 0.6, 8, 0.4, 0.9)
    assert [told.holds_against(s) for s in (-0.5, -0.05, 0.5)] == [False, True, True]
    assert not untold.holds_against(0.5)
    assert not replace(told, sessions=3).holds_against(0.5)
    buffer = held_doses(0.0)
    found = judge([], make_batch(buffer, learn_scale(buffer)), 0)
    assert (found.members, found.discarded, found.data.told) == ((), (), False)


@pytest.mark.parametrize(("controller", "asked", "counts"), [("random", True, True), ("rl", True, False), ("random", False, False)])
def test_held_out_checks_ask_for_the_dose_of_random_sessions_and_only_where_they_shall(controller: str, asked: bool, counts: bool) -> None:
    found = fitted(held_doses(-2.0, controller=controller), dose_contrast=asked, members=1)
    (check,) = found.checks
    assert [e.dose_spread > 0 for e in check.errors] == [counts] * len(check.errors)
    assert (shares([check.errors]).dose is not None) == counts
    if counts:  # an unlearnt residual model answers as its linear part, which learnt the slope from other sessions
        assert all(e.dose_predicted < 0 > e.dose_seen for e in check.errors)
