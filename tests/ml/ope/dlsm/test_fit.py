from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ml.ope.compare.metrics import accuracy
from ml.ope.dlsm.batches import make_batch
from ml.ope.dlsm.config import DlsmConfig
from ml.ope.dlsm.estimator import Dlsm
from ml.ope.dlsm.rollout import roll_out
from ml.ope.dlsm.training import MemberTraining
from ml.ope.flags import FEW_END_REWARDS
from ml.ope.scale import learn_scale
from ml.policies.policy import ConstantPolicy, ProportionalPolicy
from ml.trajectories import ReplayBuffer

TINY = DlsmConfig(latent=2, hidden=4, heads=(4,), members=2, steps=20, batch=4, check_every=5, rollouts=12, replay_draws=3, block=8)
POLICIES = {"high": ConstantPolicy(0.9), "low": ConstantPolicy(0.4)}


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


class Interrupted(Exception):
    pass


def training(buffer, config=TINY, fingerprint="this fit"):
    scale = learn_scale(buffer)
    return MemberTraining(buffer, make_batch(buffer, scale), scale, [0, 5], config, 7, fingerprint)


@pytest.mark.slow
def test_a_resumed_training_ends_exactly_where_an_uninterrupted_one_does(small_buffer, tmp_path):
    whole = training(small_buffer).run()

    def stop(fraction, message="", **numbers):
        if fraction > 0.45:
            raise Interrupted

    checkpoint = tmp_path / "member.pt"
    with pytest.raises(Interrupted):
        training(small_buffer).run(checkpoint, stop)
    resumed = training(small_buffer)
    resumed.load(checkpoint)
    assert 0 < resumed.step < TINY.steps
    member = training(small_buffer).run(checkpoint)
    assert member.course == whole.course
    assert member.check == whole.check
    for a, b in zip(member.networks.parameters(), whole.networks.parameters(), strict=True):
        assert torch.equal(a, b)


@pytest.mark.slow
def test_a_finished_fit_is_taken_from_its_checkpoints(small_buffer, tmp_path):
    first = Dlsm(TINY).fit(small_buffer, checkpoint_dir=tmp_path)
    reports = []
    again = Dlsm(TINY).fit(small_buffer, lambda *a, **k: reports.append(a), tmp_path)
    assert reports == []
    assert first.evaluate(POLICIES, 20) == again.evaluate(POLICIES, 20)


@pytest.mark.slow
def test_members_trained_on_their_own_are_the_members_of_the_ensemble(small_buffer, tmp_path):
    for k in (1, 0):
        Dlsm(TINY).fit_member(small_buffer, k, checkpoint_dir=tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["dlsm-member-0.pt", "dlsm-member-1.pt"]
    joined = Dlsm(TINY).fit(small_buffer, checkpoint_dir=tmp_path).evaluate(POLICIES, 20)
    assert joined == Dlsm(TINY).fit(small_buffer).evaluate(POLICIES, 20)
    with pytest.raises(ValueError, match="members 0 to 1, not 2"):
        Dlsm(TINY).fit_member(small_buffer, 2)


def test_a_checkpoint_of_another_buffer_is_refused(small_buffer, tmp_path):
    Dlsm(TINY).fit(small_buffer, checkpoint_dir=tmp_path)
    other = ReplayBuffer(small_buffer.settings, small_buffer.sessions[:-1], "uV", "table")
    with pytest.raises(ValueError, match="another buffer or other DLSM settings"):
        Dlsm(TINY).fit(other, checkpoint_dir=tmp_path)


def test_the_same_seed_gives_the_same_estimates_and_another_seed_others(small_buffer):
    one, two = (Dlsm(TINY).fit(small_buffer).evaluate(POLICIES, 20) for _ in range(2))
    assert one == two
    assert Dlsm(replace(TINY, seed=1)).fit(small_buffer).evaluate(POLICIES, 20)["high"].value != one["high"].value


def test_held_out_sessions_never_enter_a_gradient_step(small_buffer):
    garbled = replace(small_buffer.sessions[5], beta=small_buffer.sessions[5].beta[::-1].copy())
    sessions = tuple(garbled if i == 5 else s for i, s in enumerate(small_buffer.sessions))
    runs = []
    for buffer in (small_buffer, ReplayBuffer(small_buffer.settings, sessions, "uV", "table")):
        t = training(buffer)
        for _ in range(4):
            t.advance()
        runs.append(t)
    for a, b in zip(runs[0].networks.parameters(), runs[1].networks.parameters(), strict=True):
        assert torch.allclose(a, b, atol=1e-6)
    for t in runs:
        t.check()
    assert runs[0].course[-1][2] != pytest.approx(runs[1].course[-1][2], abs=1e-4)


def test_an_estimate_carries_its_parts_and_predictions(small_buffer):
    estimate = Dlsm(TINY).fit(small_buffer).evaluate(POLICIES, 20)["high"]
    assert estimate.value == pytest.approx(estimate.step_return + estimate.end_reward)
    assert estimate.low < estimate.value < estimate.high
    assert set(estimate.predicted) == {"energy", "mean_amplitude", "mean_beta", "grasp_hz", "rating", "tremor_percent"}
    assert estimate.predicted["energy"] == pytest.approx(0.81)
    assert estimate.predicted["mean_amplitude"] == pytest.approx(0.9)
    assert estimate.details["start"] == "observed"
    assert np.isfinite(estimate.details["value_from_other_start"])
    assert estimate.details["horizon_steps"] == 20


class TwoFaced:
    """0.5 in the logged states, next to nothing in simulated ones."""

    def __init__(self, logged_states):
        self.logged_states = logged_states

    def act(self, states):
        return np.full(len(states), 0.5) if len(states) == self.logged_states else np.linspace(0.0, 0.08, len(states))


def test_a_check_that_fails_in_simulated_sessions_is_shown_beside_a_flag_of_the_logged_ones(small_buffer):
    policies = {"two-faced": TwoFaced(len(small_buffer.transitions().states)), "half": ConstantPolicy(0.5)}
    found = Dlsm(TINY).fit(small_buffer).evaluate(policies, 20)
    flags = {(f.code, f.source): f for f in found["two-faced"].flags}
    assert flags["no_closed_loop", "logged"].value == pytest.approx(0.5)
    assert flags["as_good_as_off", "simulated"].value == 1.0
    assert flags["thin", "simulated"].refuses
    assert not found["two-faced"].supported
    assert [f.code for f in found["half"].flags].count("no_closed_loop") == 1


def test_without_any_qoc_the_estimate_is_the_step_return_and_says_so(small_buffer):
    bare = tuple(replace(s, qoc=type(s.qoc)()) for s in small_buffer.sessions)
    estimate = Dlsm(TINY).fit(ReplayBuffer(small_buffer.settings, bare, "uV", "table")).evaluate(POLICIES, 20)["low"]
    assert estimate.end_reward is None
    assert estimate.value == estimate.step_return
    assert FEW_END_REWARDS in estimate.flags


@pytest.mark.parametrize("measured", [True, False])
def test_where_no_qoc_counts_r_end_is_zero_and_judges_no_model(small_buffer, measured):
    # r_end is then the same for all. Its error as a share of that of a constant, 0, was in the tens of thousands and was in a flag.
    settings = replace(small_buffer.settings, c2=0.0, c3=0.0, c4=0.0)
    sessions = tuple(s if measured else replace(s, qoc=type(s.qoc)()) for s in small_buffer.sessions)
    fitted = Dlsm(TINY).fit(ReplayBuffer(settings, sessions, "uV", "table"))
    estimate = fitted.evaluate(POLICIES, 20)["low"]
    assert estimate.end_reward == 0
    assert estimate.value == estimate.step_return
    assert FEW_END_REWARDS not in estimate.flags
    assert fitted.held_out_skill()["score"] < 20
    assert ("grasp_hz" in estimate.predicted) == measured


def test_gaps_in_beta_and_amplitude_do_not_stop_a_fit(small_buffer):
    beta, amplitude = small_buffer.sessions[1].beta.copy(), small_buffer.sessions[1].amplitude.copy()
    beta[5:9], amplitude[20], amplitude[25] = np.nan, np.nan, 1.4
    sessions = tuple(replace(s, beta=beta, amplitude=amplitude) if i == 1 else s for i, s in enumerate(small_buffer.sessions))
    estimate = Dlsm(TINY).fit(ReplayBuffer(small_buffer.settings, sessions, "uV", "table")).evaluate(POLICIES, 20)["low"]
    assert np.isfinite(estimate.value)


def test_three_sessions_are_too_few_and_the_message_says_how_many_there_are(small_buffer):
    with pytest.raises(ValueError, match=r"at least 4 sessions.*the buffer has 3"):
        Dlsm(TINY).fit(ReplayBuffer(small_buffer.settings, small_buffer.sessions[:3], "uV", "table"))


def test_policies_that_act_alike_get_the_same_roll_outs_whatever_stands_beside_them(small_buffer):
    member = training(small_buffer).run()
    scale = learn_scale(small_buffer)
    starts = make_batch(small_buffer, scale).states[0].numpy().astype(float)

    def run(policies):
        return roll_out(member.networks, policies, starts, scale=scale, settings=small_buffer.settings, horizon=15, per_policy=4, seed=1)

    twice = run([ConstantPolicy(0.5), ConstantPolicy(0.5)])
    np.testing.assert_allclose(twice.return_known[0], twice.return_known[1])
    np.testing.assert_allclose(twice.return_known[0], run([ConstantPolicy(0.5), ConstantPolicy(0.9)]).return_known[0])


def test_a_rolled_out_window_shifts_by_one_beta_unless_the_whole_window_is_drawn(small_buffer):
    seen = []

    class Spy:
        def act(self, states):
            seen.append(states.copy())
            return np.full(len(states), 0.5)

    for config in (replace(TINY, state_terms="window"), replace(TINY, state_terms="window", decode_all_window=True)):
        seen.clear()
        scale = learn_scale(small_buffer)
        networks = training(small_buffer, config).networks
        roll_out(networks, [Spy()], np.zeros((1, 10)), scale=scale, settings=small_buffer.settings, horizon=3, per_policy=2, seed=0)
        assert np.array_equal(seen[1][:, :-1], seen[0][:, 1:]) == (not config.decode_all_window)
    with pytest.raises(ValueError, match="decode_all_window needs"):
        replace(TINY, decode_all_window=True)


def test_a_model_that_predicts_left_out_sessions_no_better_than_their_mean_says_so(small_buffer):
    unlearnt = Dlsm(replace(TINY, steps=1, learning_rate=1e-9)).fit(small_buffer).evaluate(POLICIES, 20)["low"]
    assert unlearnt.details["held_out"]["score"] > 1
    assert "no_better_than_mean" in {f.code for f in unlearnt.flags}


@pytest.mark.parametrize("bootstrap", [False, True])
@pytest.mark.parametrize(("answer", "said"), [(-0.5, True), (0.5, False)])
def test_a_model_that_answers_the_wrong_way_round_in_left_out_sessions_says_so(small_buffer, answer, said, bootstrap):
    fitted = Dlsm(replace(TINY, members=5, steps=5, bootstrap=bootstrap)).fit(small_buffer)

    def answering(check):
        return replace(check, errors=tuple(replace(e, beta_predicted=answer * e.beta_seen) for e in check.errors))

    members = tuple(replace(m, check=answering(m.check)) for m in fitted.members)
    estimate = replace(fitted, members=members).evaluate(POLICIES, 20)["low"]
    assert estimate.details["held_out"]["answer_skill"] == pytest.approx(1 - (1 - answer) ** 2)
    assert ("no_answer_to_amplitude" in {f.code for f in estimate.flags}) == said


@pytest.mark.slow
def test_policies_of_unseen_simulators_are_ranked_and_valued(simulator):
    fitted = Dlsm(replace(DlsmConfig.demo(), steps=120)).fit(simulator.buffer(seed=0))
    estimates, truth = fitted.evaluate(simulator.policies(), 300), simulator.truth()
    names = list(truth)
    result = accuracy([sum(truth[n]) for n in names], [estimates[n].value for n in names])
    known = accuracy([truth[n][0] for n in names], [estimates[n].details["step_return_known"] for n in names])
    assert result.rank_correlation > 0.9
    assert result.regret_of_range < 0.05
    assert result.mae_of_range < 0.2
    assert known.rank_correlation > 0.9


@pytest.mark.slow
def test_more_stimulation_lowers_the_beta_that_a_free_running_model_draws(linear_simulator):
    fitted = Dlsm(replace(DlsmConfig.demo(), steps=75, members=1)).fit(linear_simulator.buffer(seed=1))
    sensitive = ProportionalPolicy(linear_simulator.xi - 0.15, linear_simulator.xi + 0.15, 0.3, 1)
    estimates = fitted.evaluate({"a": ConstantPolicy(0.35), "b": sensitive, "c": ConstantPolicy(0.95)}, 200)
    assert estimates["a"].predicted["mean_beta"] > estimates["b"].predicted["mean_beta"] > estimates["c"].predicted["mean_beta"]
    # The linear system rests at 0.55 / 0.45 - (0.25 / 0.45) a.
    assert estimates["a"].predicted["mean_beta"] == pytest.approx((0.55 - 0.25 * 0.35) / 0.45, abs=0.05)


def test_outcomes_are_read_from_what_predicts_r_end_of_left_out_sessions_better(small_buffer):
    fitted = Dlsm(TINY).fit(small_buffer)
    latent = float(np.mean(np.concatenate([np.asarray(c.residual_end) for c in fitted.checks]) ** 2))
    assert fitted.end_source == ("latent" if latent <= fitted.end.by_session.residual[0] ** 2 else "summaries")
    ends = (replace(fitted.end, by_session=replace(fitted.end.by_session, residual=np.full(4, error))) for error in (0.0, 1e6))
    exact, useless = (replace(fitted, end=end) for end in ends)
    assert (exact.end_source, useless.end_source) == ("summaries", "latent")


def test_outcomes_from_summaries_are_the_regressions_at_the_simulated_sessions(small_buffer):
    config = replace(TINY, end_source="summaries")
    fitted = Dlsm(config).fit(small_buffer)
    found = fitted.evaluate(POLICIES, 30)
    starts = fitted.batch.states[0].numpy().astype(np.float64)
    ends = []
    for k, member in enumerate(fitted.members):
        run = roll_out(
            member.networks,
            list(POLICIES.values()),
            starts,
            scale=fitted.scale,
            settings=small_buffer.settings,
            horizon=30,
            per_policy=config.rollouts,
            seed=config.seed + 1000 + k,
        )
        np.testing.assert_allclose(run.amplitude[0], 0.9)
        np.testing.assert_allclose(run.energy[0], 0.81)
        np.testing.assert_allclose(run.minutes.share.sum(-1), 1.0)
        ends.append(fitted.end.predict(run.minutes)[:, :, 0].mean(1))
    for i, name in enumerate(POLICIES):
        assert found[name].end_reward == pytest.approx(np.mean(ends, axis=0)[i])
        assert found[name].details["end_source"] == "summaries"
