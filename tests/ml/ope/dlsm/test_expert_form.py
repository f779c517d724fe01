"""Additions of the DLSM to the paper's form: a linear part, the known reward, free bits, free runs from posterior states, resampling."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from ml.ope.dlsm.batches import make_batch
from ml.ope.dlsm.config import DlsmConfig
from ml.ope.dlsm.estimator import Dlsm
from ml.ope.dlsm.folds import resampled
from ml.ope.dlsm.linear_part import LinearPart
from ml.ope.dlsm.networks import DlsmNetworks
from ml.ope.dlsm.rollout import LinearRun
from ml.ope.linear.dynamics import SessionTable
from ml.ope.registry import build
from ml.ope.scale import learn_scale
from ml.policies.policy import ConstantPolicy
from ml.trajectories import ReplayBuffer

TINY: dict[str, Any] = {
    "latent": 2, "hidden": 4, "heads": (4,), "members": 2, "steps": 20, "batch": 4, "check_every": 5, "rollouts": 12, "replay_draws": 3,
}  # fmt: skip
PLAIN = DlsmConfig(**TINY)
RESIDUAL = replace(PLAIN, residual=True, reward_terms=False)
UNLEARNT = replace(RESIDUAL, steps=1, learning_rate=1e-9)


@pytest.fixture
def part(small_buffer: ReplayBuffer) -> LinearPart:
    return LinearPart.fit(small_buffer, learn_scale(small_buffer), range(len(small_buffer.sessions)))


def terms_of(config: DlsmConfig, buffer: ReplayBuffer, seed: int = 1) -> tuple[DlsmNetworks, Any, Any]:
    """Build a double-precision model with its batch and noise."""
    torch.manual_seed(0)
    batch = make_batch(buffer, learn_scale(buffer), torch.float64)
    net = DlsmNetworks(10, config).double()
    return net, batch, net.noise(*batch.size, torch.Generator().manual_seed(seed))


def test_an_unlearnt_residual_model_of_a_linear_system_gives_the_linear_answer(linear_simulator: Any) -> None:
    fitted = Dlsm(replace(UNLEARNT, rollouts=200, members=1)).fit(linear_simulator.buffer(seed=1))
    found = fitted.evaluate({str(a): ConstantPolicy(a) for a in (0.35, 0.65, 0.95)}, 200)
    for a in (0.35, 0.65, 0.95):  # the system rests at 0.55 / 0.45 - (0.25 / 0.45) a
        assert found[str(a)].predicted["mean_beta"] == pytest.approx((0.55 - 0.25 * a) / 0.45, abs=0.04)
        assert found[str(a)].details["reward_source"] == "known"


def test_what_the_linear_part_leaves_is_what_its_equation_leaves_of_every_step(small_buffer: ReplayBuffer, part: LinearPart) -> None:
    scale, w = learn_scale(small_buffer), small_buffer.settings.window
    batch = part.of(make_batch(small_buffer, scale, torch.float64))
    assert batch.left is not None
    for i, session in enumerate(small_buffer.sessions):
        before = None if np.isnan(part.before[i]) else float(part.before[i])
        table = SessionTable.of(session, scale, before)
        eta = table.beta - part.level - table.answers @ part.answer
        for t in (0, 1, session.steps // 2, session.steps - 1):
            left = eta[w + t] - sum(part.phi[lag - 1] * eta[w + t - lag] for lag in range(1, w + 1))
            assert float(batch.left[t, i]) * part.noise == pytest.approx(left)
    left = np.concatenate([batch.left[: s.steps, i].numpy()[s.usable()] for i, s in enumerate(small_buffer.sessions)])
    assert np.mean(left**2) == pytest.approx(1.0)


def test_a_roll_out_predicts_what_training_predicts_from_the_same_past(small_buffer: ReplayBuffer, part: LinearPart) -> None:
    batch = part.of(make_batch(small_buffer, learn_scale(small_buffer), torch.float64))
    steps = int(batch.lengths.min())
    run = LinearRun(part, part.before, 1)
    for t in range(steps):
        predicted = run.predicted(batch.states[t].numpy(), batch.actions[t].numpy())
        np.testing.assert_allclose(batch.states[t + 1, :, -1] - batch.left[t] * part.noise, predicted, atol=1e-9)  # type: ignore[index]


def test_a_free_run_with_the_noise_that_was_is_the_session_that_was(small_buffer: ReplayBuffer, part: LinearPart) -> None:
    batch = part.of(make_batch(small_buffer, learn_scale(small_buffer), torch.float64)).cut(30)
    assert batch.left is not None
    assert batch.resting is not None
    lead, rest, left = batch.states[0].numpy(), batch.resting.numpy(), batch.left.numpy()
    zero = np.zeros_like(left)
    means = part.run(lead, rest, zero, np.ones_like(left), left)
    np.testing.assert_allclose(means + part.noise * left, batch.states[1:, :, -1], atol=1e-9)
    np.testing.assert_allclose(part.run(lead, rest, left, zero, zero), batch.states[1:, :, -1], atol=1e-9)


def test_left_out_sessions_move_no_linear_part(small_buffer: ReplayBuffer) -> None:
    sessions = list(small_buffer.sessions)
    sessions[4] = replace(sessions[4], beta=sessions[4].beta[::-1].copy())
    scale, others = learn_scale(small_buffer), [i for i in range(len(sessions)) if i != 4]
    found = [LinearPart.fit(replace(small_buffer, sessions=tuple(s)), scale, others) for s in (small_buffer.sessions, sessions)]
    np.testing.assert_array_equal(found[0].phi, found[1].phi)
    np.testing.assert_array_equal(found[0].answer, found[1].answer)


@pytest.mark.parametrize("objective", ["posterior", "sum"])
def test_without_its_density_the_reward_is_in_no_objective(small_buffer: ReplayBuffer, objective: Any) -> None:
    losses = []
    for reward_terms in (True, False):
        net, batch, noise = terms_of(replace(PLAIN, objective=objective, reward_terms=reward_terms), small_buffer)
        losses.append([net.loss(b, noise).item() for b in (batch, replace(batch, rewards=batch.rewards + 1.0))])
    assert losses[0][0] != losses[0][1]
    assert losses[1][0] == losses[1][1]


def test_the_known_reward_is_the_source_where_no_head_was_learnt(small_buffer: ReplayBuffer) -> None:
    fitted = Dlsm(replace(PLAIN, reward_terms=False)).fit(small_buffer)
    assert fitted.reward_source == "known"
    assert all(c.error_head == c.error_known for c in fitted.checks)
    with pytest.raises(ValueError, match="needs reward_terms"):
        replace(PLAIN, reward_terms=False, reward_source="head")


def test_a_step_costs_its_free_bits_at_least_and_no_more_where_it_has_more(small_buffer: ReplayBuffer) -> None:
    net, batch, noise = terms_of(PLAIN, small_buffer)
    plain = net.posterior_terms(batch, noise).kl_path
    for bits, expected in ((1e-12, plain), (1e6, 1e6 * batch.alive.sum(0))):
        net.config = replace(PLAIN, free_bits=bits)
        torch.testing.assert_close(net.posterior_terms(batch, noise).kl_path, expected)
    with pytest.raises(ValueError, match="at least 0"):
        replace(PLAIN, free_bits=-0.1)


def test_a_free_run_from_a_block_follows_the_encoder_up_to_it(small_buffer: ReplayBuffer) -> None:
    config = replace(PLAIN, overshoot=10)
    net, batch, noise = terms_of(config, small_buffer)
    noise = replace(noise, start=20)
    a = batch.actions.unsqueeze(-1)
    with torch.no_grad():
        z0, _, _ = net._first(batch, noise)
        posterior, _, _ = net.encoder.run(torch.cat([a, batch.states[1:]], dim=2), z0, noise.encoder)
        z, _, _ = net.decoder.run(a, z0, net._along_posterior(batch, noise, z0, fast=True))
    torch.testing.assert_close(z[:20], posterior[:20])
    assert float((z[20] - posterior[20]).abs().max()) > 1e-2


def test_only_the_steps_of_the_free_run_are_reconstructed_and_its_starts_are_drawn_anew(small_buffer: ReplayBuffer) -> None:
    net, batch, noise = terms_of(replace(PLAIN, overshoot=10), small_buffer)
    generator = torch.Generator().manual_seed(0)
    starts = {net.noise(*batch.size, generator).start for _ in range(40)}
    assert starts == set(range(0, 10 * (batch.size[0] // 10), 10))
    early = batch.rewards.clone()
    early[:20] += 5.0
    moved = replace(batch, rewards=early)
    for start, same in ((20, True), (10, False)):
        at = replace(noise, start=start)
        both = [net.free_running_terms(b, at).rewards for b in (batch, moved)]
        assert torch.equal(*both) == same


def test_a_resampled_member_learns_from_as_many_sessions_as_there_are_and_never_from_those_left_out(small_buffer: ReplayBuffer) -> None:
    n, drawn = len(small_buffer.sessions), [resampled(small_buffer, seed) for seed in range(60)]
    for learnt, held in drawn:
        assert len(learnt) == n
        assert set(learnt) | set(held) == set(range(n))
        assert not set(learnt) & set(held)
        assert len(held) >= 2
    # a session is excluded with probability (1 - 1/n)^n
    assert np.mean([len(held) / n for _, held in drawn]) == pytest.approx((1 - 1 / n) ** n, abs=0.05)
    fitted = Dlsm(replace(PLAIN, bootstrap=True)).fit(small_buffer)
    assert [sorted(m.check.sessions) for m in fitted.members] == [resampled(small_buffer, k)[1] for k in (0, 1)]


@pytest.mark.parametrize(
    ("settings", "said"),
    [({"residual": True, "state_terms": "window"}, "residual needs state_terms"), ({"overshoot": -1}, "at least 0")],
)
def test_settings_that_do_not_go_together_are_refused(settings: dict[str, Any], said: str) -> None:
    with pytest.raises(ValueError, match=said):
        DlsmConfig(**settings)


def test_a_residual_model_says_when_a_batch_lacks_its_linear_part(small_buffer: ReplayBuffer) -> None:
    net, batch, noise = terms_of(RESIDUAL, small_buffer)
    with pytest.raises(ValueError, match="the batch has none"):
        net.posterior_terms(batch, noise)


def test_the_unlearnt_model_is_one_of_the_checks(small_buffer: ReplayBuffer) -> None:
    members = Dlsm(RESIDUAL).fit(small_buffer).members
    assert [m.course[0][0] for m in members] == [0, 0]
    assert [m.course[1][0] for m in members] == [5, 5]


def test_the_dlsm_of_a_job_is_the_expert_form_at_its_size() -> None:
    for size in ("full", "demo"):
        built = build("dlsm", 3, size)  # type: ignore[arg-type]
        assert isinstance(built, Dlsm)
        assert built.config == DlsmConfig.expert(size, 3)  # type: ignore[arg-type]
        assert built.config.members == DlsmConfig.of_size(size, 3).members  # type: ignore[arg-type]
