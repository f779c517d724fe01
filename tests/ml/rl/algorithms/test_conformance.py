"""Contract of every learning algorithm, tested on each of the registry in the same way."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from ml.policies.onnx_policy import OnnxPolicy
from ml.rl import (
    ALGORITHMS,
    CheckpointError,
    HeldOutSessions,
    MlpPolicy,
    TrainedPolicy,
    TrainingDiverged,
    algorithm,
    split_sessions,
    train,
    train_many,
)
from ml.rl.kernels.batches import RewardScale, batch_noise, packed

NAMES = sorted(ALGORITHMS)
CRITICS = {"ddpg": {"critic"}, "td3_bc": {"critic", "critic_2"}, "rebrac": {"critic", "critic_2"}, "cloning": set()}
CRITICS["iql"] = {"critic", "critic_2", "value"}


class StoppedHere(Exception):
    pass


@pytest.fixture(params=NAMES)
def name(request):
    return request.param


def small(name, **changes):
    values = {"hidden": (16, 12), "updates": 300, "batch": 16, "record_every": 10, "checkpoint_every": 23, "actor_lr": 1e-3}
    return algorithm(name).config(**(values | changes))


def stop_at(update, updates=300):
    def report(fraction, message="", **numbers):
        if round(fraction * updates) >= update:
            raise StoppedHere

    return report


def learner_of(name, buffer, count=1, **changes):
    """Build a learner, its data and a batch of it."""
    configs = [small(name, seed=k, **changes) for k in range(count)]
    kind = algorithm(name).learner
    mean, std = buffer.beta_scale()
    starts = [kind.networks(c, MlpPolicy(10, c.hidden, mean=mean, std=std, seed=c.seed), [c.seed + i for i in range(3)]) for c in configs]
    transitions = buffer.transitions()
    scale = RewardScale.of(transitions.rewards, 0.99)
    data = packed(transitions, starts[0]["policy"].normalise, scale)
    index = torch.from_numpy(np.random.default_rng(3).integers(0, len(data), (count, 16)))
    return kind(starts, configs, scale), data, data.take(index, batch_noise(0, 0, 16)[:count])


def assert_same(one, two):
    assert one.policy.to_onnx() == two.policy.to_onnx()
    assert one.networks.keys() == two.networks.keys()
    for own in one.networks:
        for left, right in zip(one.networks[own].parameters(), two.networks[own].parameters(), strict=True):
            np.testing.assert_array_equal(left.detach().numpy(), right.detach().numpy())
    for curve in ("curve", "held_out"):
        left, right = getattr(one, curve), getattr(two, curve)
        assert left.keys() == right.keys()
        for key in left:
            np.testing.assert_array_equal(left[key], right[key])


# --- what comes back ----------------------------------------------------------------------------------------------------------------


def test_the_policy_has_the_papers_shape_and_its_answers_are_fractions(name, buffer):
    trained = train(buffer, algorithm(name).config(updates=2))
    assert trained.policy.hidden == (400, 300)
    answers = trained.policy.act(np.concatenate([buffer.transitions().states, np.array([[1e9] * 10, [-1e9] * 10])]))
    assert answers.shape == (len(buffer.transitions().states) + 2,)
    assert np.all((answers >= 0) & (answers <= 1))
    assert set(trained.networks) == CRITICS[name]
    assert (trained.algorithm, trained.seed) == (name, 0)


def test_the_onnx_file_answers_as_the_policy_does(name, buffer):
    trained = train(buffer, small(name, updates=60))
    states = buffer.transitions().states
    expected = trained.policy.act(states)
    assert expected.std() > 1e-3, "the comparison needs answers that differ"
    np.testing.assert_allclose(OnnxPolicy(trained.policy.to_onnx(), 10).act(states), expected, atol=1e-5)


def test_curves_are_of_one_length_and_their_last_point_is_that_of_the_policy(name, buffer):
    trained = train(buffer, small(name))
    assert {len(values) for values in trained.curve.values()} == {30}
    assert ("mean_q" in trained.curve) == ("critic" in trained.networks)
    logged = buffer.transitions()
    distance = np.abs(trained.policy.act(logged.states) - logged.actions).mean()
    assert trained.curve["action_distance"][-1] == pytest.approx(distance, abs=1e-5)


# --- configuration ------------------------------------------------------------------------------------------------------------------


def test_a_configuration_goes_through_json_says_what_its_fields_mean_and_refuses_unknown_names(name):
    kind = algorithm(name).config
    config = small(name, seed=4)
    assert kind.from_json(config.to_json()) == config
    assert kind.from_json({}) == kind()
    docs = kind.field_docs()
    assert set(docs) == {f.name for f in dataclasses.fields(kind)}
    assert all(len(text) > 10 and text.endswith(".") for text in docs.values())
    with pytest.raises(ValueError, match=f"{name} has no hyper-parameter gamma"):
        kind.from_json({"gamma": 0.9})


def test_every_number_outside_its_range_is_refused_by_name(name):
    kind = algorithm(name).config
    checked = 0
    for described in dataclasses.fields(kind):
        if "high" in described.metadata:
            for wrong in (-1, float("nan"), *([described.metadata["high"] * 2] if described.metadata["high"] < np.inf else [])):
                with pytest.raises(ValueError, match=described.name):
                    kind(**{described.name: wrong})
                checked += 1
    assert checked >= 12
    with pytest.raises(ValueError, match="hidden"):
        kind(hidden=(4,))
    with pytest.raises(ValueError, match="device"):
        kind(device="tpu")


def test_an_unknown_algorithm_is_refused_with_the_names_that_exist():
    with pytest.raises(ValueError, match="rebrac"):
        algorithm("sarsa")


# --- reproducible -------------------------------------------------------------------------------------------------------------------


def test_the_same_buffer_configuration_and_seed_give_the_same_training_bit_for_bit(name, buffer):
    one, two = train(buffer, small(name, updates=60)), train(buffer, small(name, updates=60))
    assert_same(one, two)
    assert one.policy.to_onnx() != train(buffer, small(name, updates=60, seed=1)).policy.to_onnx()


@pytest.mark.parametrize("count", [1, 3])
def test_a_training_that_was_interrupted_ends_as_one_that_was_not(name, count, buffer, tmp_path):
    file = tmp_path / "training.ckpt"
    learnt, held = split_sessions(buffer, 0.3)
    watch = HeldOutSessions(sessions=held, score=lambda policy: float(policy.act(held.transitions().states).mean()), every=9)
    configs = [small(name, seed=k, actor_lr=10.0 ** -(3 + 0.2 * k)) for k in range(count)]
    whole = train_many(learnt, configs, held_out=watch)
    for stop in (40, 270):  # neither a multiple of the checkpoint's 23 updates nor of the 256 of a block of batches
        with pytest.raises(StoppedHere):
            train_many(learnt, configs, stop_at(stop), file, held_out=watch)
    seen = []
    resumed = train_many(learnt, configs, lambda f, message="", **n: seen.append(round(f * 300)), file, held_out=watch)
    assert seen[0] >= 250, "it must go on from the checkpoint, not start again"
    for one, two in zip(whole, resumed, strict=True):
        assert_same(one, two)
        assert one.best_update == two.best_update
    again = train_many(learnt, configs, stop_at(0), file, held_out=watch)
    assert_same(again[0], whole[0])


def test_a_report_that_raises_cancels_the_training(name, buffer):
    with pytest.raises(StoppedHere):
        train(buffer, small(name), stop_at(20))


def test_the_checkpoint_of_another_run_is_refused(name, buffer, tmp_path):
    file = tmp_path / "training.ckpt"
    train(buffer, small(name, updates=7), checkpoint=file)
    with pytest.raises(CheckpointError, match="another configuration"):
        train(buffer, small(name, updates=8), checkpoint=file)
    other = "cloning" if name != "cloning" else "ddpg"
    with pytest.raises(CheckpointError, match="other data"):
        train(buffer, small(other, updates=7), checkpoint=file)


def test_an_update_leaves_its_batch_and_the_buffer_as_they_are(name, buffer):
    learner, data, batch = learner_of(name, buffer, count=2)
    before, copies = data.digest(), [None if x is None else x.clone() for x in batch]
    for _ in range(3):
        learner.update(batch)
    assert all(torch.equal(a, b) for a, b in zip(batch, copies, strict=True) if b is not None)
    assert data.digest() == before


def test_measuring_changes_nothing_that_the_next_update_depends_on(name, buffer):
    watched, data, batch = learner_of(name, buffer)
    alone, *_ = learner_of(name, buffer)
    for _ in range(4):
        watched.update(batch)
        alone.update(batch)
        watched.measure(data.probe())
        watched.start_values(buffer.transitions().states[:5], np.zeros((5, 0)))
    for stack, other in zip(watched.stacks.values(), alone.stacks.values(), strict=True):
        assert torch.equal(stack.weights, other.weights)


# --- stored and tuned further -------------------------------------------------------------------------------------------------------


def test_a_stored_training_comes_back_and_is_tuned_to_the_same_weights(name, buffer):
    first = train(buffer, small(name, updates=50))
    back = TrainedPolicy.from_bytes(first.to_bytes())
    assert_same(first, back)
    assert back.config == first.config
    gentle = small(name, updates=50, actor_lr=1e-6)
    tuned = train(buffer, gentle, initial=back)
    assert_same(tuned, train(buffer, gentle, initial=first))
    moved = np.abs(tuned.policy.act(buffer.transitions().states) - first.policy.act(buffer.transitions().states)).max()
    assert 0 < moved < 1e-2
    assert_same(first, back)


def test_a_training_of_another_algorithm_cannot_be_gone_on_with_but_its_policy_can(name, buffer):
    other = "iql" if name != "iql" else "ddpg"
    first = train(buffer, small(other, updates=5))
    with pytest.raises(ValueError, match="start from its policy alone"):
        train(buffer, small(name, updates=5), initial=first)
    assert train(buffer, small(name, updates=5), initial=first.policy).policy.hidden == (16, 12)


def test_bytes_of_something_else_are_refused():
    with pytest.raises(ValueError, match="no stored weights"):
        TrainedPolicy.from_bytes(b"something else")


def test_a_training_that_diverges_says_so(name, buffer):
    broken = MlpPolicy(10, (16, 12), mean=100.0, std=40.0)
    with torch.no_grad():
        broken.layers[0].bias.fill_(float("inf"))
    with pytest.raises(TrainingDiverged, match="diverged"):
        train(buffer, small(name), initial=broken)


# --- kept near a constant amplitude -------------------------------------------------------------------------------------------------

HELD = {"td3_bc": {"alpha": 1e30}, "rebrac": {"actor_penalty": 0.0}}
"""Algorithms whose actor is kept near an anchor, with a bond of no strength."""


def test_every_algorithm_that_is_held_near_an_anchor_is_known_here():
    assert set(HELD) == {name for name, kind in ALGORITHMS.items() if "anchor" in kind.config.field_docs()}


@pytest.mark.parametrize("name", sorted(HELD))
def test_without_a_bond_the_anchor_changes_nothing_bit_for_bit(name, buffer):
    free, held = (train(buffer, small(name, updates=60, anchor=anchor, **HELD[name])) for anchor in ("logged", "constant"))
    assert_same(free, held)
    bound = train(buffer, small(name, updates=60, anchor="constant"))
    assert bound.policy.to_onnx() != train(buffer, small(name, updates=60)).policy.to_onnx()


@pytest.mark.parametrize("name", sorted(HELD))
def test_anchors_of_policies_side_by_side_are_their_own_and_a_training_at_one_resumes(name, buffer, tmp_path):
    file = tmp_path / "training.ckpt"
    strong = {"alpha": 0.02} if name == "td3_bc" else {"actor_penalty": 50.0}
    configs = [small(name, anchor="constant", anchor_amplitude=level, seed=3, **strong) for level in (1.0, 0.4)]
    high, low = train_many(buffer, configs)
    states = buffer.transitions().states
    np.testing.assert_allclose(low.policy.act(states), train(buffer, configs[1]).policy.act(states), atol=1e-4)
    assert high.policy.act(states).mean() > low.policy.act(states).mean() + 0.1
    with pytest.raises(StoppedHere):
        train_many(buffer, configs, stop_at(200), file)
    resumed = train_many(buffer, configs, checkpoint=file)
    assert_same(resumed[0], high)
    assert_same(resumed[1], low)
    assert TrainedPolicy.from_bytes(low.to_bytes()).config == configs[1]


@pytest.mark.parametrize("name", sorted(HELD))
def test_the_publications_anchor_is_the_default_and_an_unknown_one_is_refused(name, buffer):
    assert algorithm(name).config().anchor == "logged"
    with pytest.raises(ValueError, match="anchor must be one of logged, constant"):
        small(name, anchor="best")
    with pytest.raises(ValueError, match="may differ in actor_lr"):
        train_many(buffer, [small(name), small(name, anchor="constant")])


# --- devices ------------------------------------------------------------------------------------------------------------------------


def test_without_cuda_auto_is_the_processor_and_cuda_is_refused(name, buffer, monkeypatch):
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    assert small(name, device="auto").resolved_device() == "cpu"
    with pytest.raises(ValueError, match="no CUDA device; use auto or cpu"):
        train(buffer, small(name, device="cuda"))
    auto = train(buffer, small(name, updates=20, device="auto"))
    assert_same(auto, train(buffer, small(name, updates=20)))


@pytest.mark.skipif(not torch.cuda.is_available(), reason="no CUDA device: that both devices agree cannot be tested here")
def test_both_devices_agree(name, buffer, tmp_path):
    processor, card = (train(buffer, small(name, updates=100, device=device)) for device in ("cpu", "cuda"))
    states = buffer.transitions().states
    np.testing.assert_allclose(card.policy.act(states), processor.policy.act(states), atol=1e-3)
    for key, values in processor.curve.items():
        np.testing.assert_allclose(card.curve[key], values, rtol=1e-2, atol=1e-3)
    assert TrainedPolicy.from_bytes(card.to_bytes()).policy.to_onnx() == card.policy.to_onnx()
