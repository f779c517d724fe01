from __future__ import annotations

import numpy as np
import pytest
import torch

from ml.rl import ALGORITHMS, MlpPolicy, algorithm, train, train_many
from ml.rl.kernels.networks import Critic, Value
from ml.rl.kernels.stacked import Stack, StackedActor, StackedAdam, into_module

SIZES, BATCH = (16, 12), 8


def grown(network, factor=100.0):
    """Scale last layers as after some training: the first ones are nearly 0."""
    with torch.no_grad():
        network.layers[-1].weight.mul_(factor)
    return network


def flat(network, loss):
    return torch.cat([g.reshape(-1) for g in torch.autograd.grad(loss, list(network.parameters()))])


def inputs(count, seed=0):
    g = torch.Generator().manual_seed(seed)
    shape = (count, BATCH)
    return torch.randn(*shape, 10, generator=g), torch.rand(*shape, 1, generator=g), torch.randn(*shape, 1, generator=g)


@pytest.mark.parametrize("count", [1, 3])
@pytest.mark.parametrize("layer_norm", [False, True])
@pytest.mark.parametrize("sizes", [(16, 12), (9, 8, 7)])
def test_a_stacked_critic_has_the_values_and_gradients_of_its_members(count, layer_norm, sizes):
    members = [grown(Critic(10, sizes, layer_norm=layer_norm, seed=k)) for k in range(count)]
    stack = Stack(members, BATCH)
    scores, actions, slope = inputs(count)
    values = stack.forward(scores, actions).clone()
    stack.backward(slope)
    by_action = stack.action_gradient(slope)
    for k, member in enumerate(members):
        own = actions[k].clone().requires_grad_()
        expected = member(scores[k], own)
        np.testing.assert_allclose(values[k], expected.detach(), rtol=2e-4, atol=1e-5)
        loss = (expected * slope[k]).sum()
        np.testing.assert_allclose(by_action[k], torch.autograd.grad(loss, own, retain_graph=True)[0], rtol=2e-3, atol=1e-4)
        np.testing.assert_allclose(stack.gradient[k], flat(member, loss), rtol=2e-3, atol=2e-4)


@pytest.mark.parametrize("count", [1, 3])
def test_stacked_policies_and_value_functions_have_the_gradients_of_their_members(count):
    scores, _, slope = inputs(count)
    policies, values = ([grown(kind(10, SIZES, seed=k)) for k in range(count)] for kind in (MlpPolicy, Value))
    actor, value = StackedActor(policies, BATCH), Stack(values, BATCH)
    actions = actor.act(scores)
    actor.backward_from_actions(slope, actions)
    value.forward(scores)
    value.backward(slope)
    for k in range(count):
        expected = policies[k].act_on_scores(scores[k])
        np.testing.assert_allclose(actions[k], expected.detach(), atol=1e-6)
        np.testing.assert_allclose(actor.gradient[k], flat(policies[k], (expected * slope[k]).sum()), rtol=2e-3, atol=1e-5)
        np.testing.assert_allclose(value.gradient[k], flat(values[k], (values[k](scores[k]) * slope[k]).sum()), rtol=2e-3, atol=2e-4)


def test_adam_takes_the_steps_of_pytorchs_own_with_a_rate_per_member():
    rates, decay = (1e-3, 1e-2), 1e-2
    stack = Stack([Value(10, SIZES, seed=k) for k in range(2)], BATCH)
    weights = [stack.weights[k].clone().requires_grad_() for k in range(2)]
    peers = [torch.optim.Adam([w], lr=rate, weight_decay=decay, fused=True) for w, rate in zip(weights, rates, strict=True)]
    adam = StackedAdam(stack, rates, decay)
    for step in range(5):
        stack.gradient.copy_(torch.randn(stack.gradient.shape, generator=torch.Generator().manual_seed(step)))
        for k, peer in enumerate(peers):
            weights[k].grad = stack.gradient[k].clone()
            peer.step()
        adam.step()
        for k in range(2):
            assert torch.equal(stack.weights[k], weights[k].detach())


def test_a_gradient_of_other_rows_than_the_last_forward_pass_is_refused():
    stack = Stack([Critic(10, SIZES)], BATCH)
    scores, actions, slope = inputs(1)
    with pytest.raises(ValueError, match="none"):
        stack.backward(slope)
    stack.forward(scores, actions)
    with pytest.raises(ValueError, match=r"\[1, 8, 1\], not \[1, 5, 1\]"):
        stack.action_gradient(slope[:, :5])


def test_members_leave_the_stack_as_they_came():
    members = [Critic(10, SIZES, seed=k) for k in range(3)]
    stack, back = Stack(members, BATCH), Critic(10, SIZES, seed=9)
    into_module(stack.weights[1], back)
    for one, two in zip(back.parameters(), members[1].parameters(), strict=True):
        assert torch.equal(one, two)


@pytest.mark.parametrize("name", sorted(ALGORITHMS))
def test_policies_trained_side_by_side_are_those_trained_one_by_one(name, buffer):
    kind = algorithm(name)
    shared = {"hidden": (32, 24), "updates": 100, "batch": 32, "record_every": 50}
    configs = [kind.config(**shared, seed=k, actor_lr=10.0 ** -(3 + k / 5)) for k in range(6)]
    together = train_many(buffer, configs)
    states = buffer.transitions().states
    answers = np.stack([one.policy.act(states) for one in together])
    assert np.abs(answers[1:] - answers[0]).mean(axis=1).min() > 1e-3, "the members must differ"
    for config, one in zip(configs, together, strict=True):
        alone = train(buffer, config)
        np.testing.assert_allclose(one.policy.act(states), alone.policy.act(states), atol=1e-4)
        assert one.config == config
        for key, values in alone.curve.items():
            np.testing.assert_allclose(one.curve[key], values, rtol=2e-3, atol=1e-4)


def test_a_member_does_not_depend_on_its_neighbours(buffer):
    kind = algorithm("ddpg")
    shared = {"hidden": (32, 24), "updates": 60, "batch": 32}
    one, other = kind.config(**shared, seed=1), kind.config(**shared, seed=2)
    wild = kind.config(**shared, seed=3, actor_lr=0.1, critic_lr=0.1)
    calm = train_many(buffer, [one, other])[0].policy
    assert calm.to_onnx() == train_many(buffer, [one, wild])[0].policy.to_onnx()


def test_configurations_that_cannot_share_their_calls_are_refused_by_name(buffer):
    kind = algorithm("rebrac")
    with pytest.raises(ValueError, match="not in tau; train them apart"):
        train_many(buffer, [kind.config(), kind.config(tau=0.1)])
    with pytest.raises(ValueError, match="have one algorithm, not rebrac and ddpg"):
        train_many(buffer, [kind.config(), algorithm("ddpg").config()])
    with pytest.raises(ValueError, match="one configuration or more"):
        train_many(buffer, [])


def test_points_of_several_policies_are_told_by_number(buffer):
    kind, told = algorithm("cloning"), {}
    configs = [kind.config(hidden=(8, 8), updates=10, seed=k) for k in range(2)]
    trained = train_many(buffer, configs, lambda fraction, message="", **numbers: told.update(numbers))
    assert set(told) == {f"{name}_{k}" for name in ("cloning_loss", "action_distance", "saturated") for k in (1, 2)}
    assert told["action_distance_2"] == trained[1].curve["action_distance"][-1]
