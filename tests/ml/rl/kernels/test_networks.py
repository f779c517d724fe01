from __future__ import annotations

import math

import numpy as np
import onnx
import onnxruntime as ort
import pytest
import torch

from ml.policies.onnx_policy import OnnxPolicy, PolicyFileError
from ml.rl import STUDENT_HIDDEN, TEACHER_HIDDEN, MlpPolicy
from ml.rl.kernels.networks import Critic


def trained_like(hidden, *, window=10, seed=3):
    """Build a policy whose answers spread over [0, 1], as after training: the last layer's first weights are nearly 0."""
    policy = MlpPolicy(window, hidden, mean=120.0, std=35.0, seed=seed)
    with torch.no_grad():
        policy.layers[-1].weight.mul_(1000)
    return policy


def windows(n, window=10, seed=0):
    return np.random.default_rng(seed).normal(120.0, 60.0, (n, window))


def by_hand(policy, window):
    """Compute the network in plain loops, float64."""
    x = [(b - float(policy.mean)) / float(policy.std) for b in window]
    for i, layer in enumerate(policy.layers):
        rows, bias = layer.weight.tolist(), layer.bias.tolist()
        x = [sum(w * v for w, v in zip(row, x, strict=True)) + b for row, b in zip(rows, bias, strict=True)]
        if i < len(policy.layers) - 1:
            x = [max(v, 0.0) for v in x]
    return (math.tanh(x[0]) + 1) / 2


def test_the_network_computes_what_its_text_says():
    policy = trained_like((7, 5), window=4)
    states = windows(20, 4)
    np.testing.assert_allclose(policy.act(states), [by_hand(policy, s) for s in states], atol=2e-6)


@pytest.mark.parametrize("hidden", [TEACHER_HIDDEN, STUDENT_HIDDEN])
def test_onnx_equals_torch_within_1e_5(hidden):
    policy, states = trained_like(hidden), windows(500)
    expected = policy.act(states)
    assert expected.std() > 0.1, "the comparison needs answers that differ"
    (raw,) = ort.InferenceSession(policy.to_onnx()).run(["amplitude_fraction"], {"beta_window": states.astype(np.float32)})
    assert raw.shape == (500, 1)
    np.testing.assert_allclose(raw[:, 0], expected, atol=1e-5)
    np.testing.assert_allclose(OnnxPolicy(policy.to_onnx(), 10).act(states), expected, atol=1e-5)


def test_answers_are_float64_fractions_even_for_absurd_beta():
    answers = trained_like(TEACHER_HIDDEN).act(np.array([[1e9] * 10, [-1e9] * 10, [0.0] * 10]))
    assert answers.dtype == np.float64
    assert answers.shape == (3,)
    assert np.all((answers >= 0) & (answers <= 1))


def test_a_new_policy_answers_near_one_half():
    assert np.abs(MlpPolicy(10, mean=120.0, std=35.0).act(windows(100)) - 0.5).max() < 0.05


def test_the_onnx_file_states_its_names_shapes_and_opset():
    model = onnx.load_model_from_string(trained_like(STUDENT_HIDDEN).to_onnx())
    onnx.checker.check_model(model, full_check=True)
    assert model.opset_import[0].version == 17
    (given,), (answer,) = model.graph.input, model.graph.output
    assert (given.name, answer.name) == ("beta_window", "amplitude_fraction")
    assert [d.dim_param or d.dim_value for d in given.type.tensor_type.shape.dim] == ["N", 10]
    assert [d.dim_param or d.dim_value for d in answer.type.tensor_type.shape.dim] == ["N", 1]


def test_the_same_weights_give_the_same_onnx_bytes():
    assert trained_like((20, 10), seed=5).to_onnx() == trained_like((20, 10), seed=5).to_onnx()
    assert trained_like((20, 10), seed=5).to_onnx() != trained_like((20, 10), seed=6).to_onnx()


def test_a_policy_comes_back_from_its_onnx_file_bit_for_bit():
    policy = trained_like((20, 10))
    back = MlpPolicy.from_onnx(policy.to_onnx())
    assert back.hidden == (20, 10)
    np.testing.assert_array_equal(back.act(windows(50)), policy.act(windows(50)))
    assert back.to_onnx() == policy.to_onnx()


def test_only_our_own_onnx_files_come_back_as_networks():
    model = onnx.load_model_from_string(trained_like((4, 4)).to_onnx())
    del model.metadata_props[:]
    with pytest.raises(PolicyFileError, match="not written by betaloop"):
        MlpPolicy.from_onnx(model.SerializeToString())
    with pytest.raises(PolicyFileError, match="not an ONNX file"):
        MlpPolicy.from_onnx(b"\xff not onnx")


def test_a_damaged_file_of_ours_names_what_is_missing():
    model = onnx.load_model_from_string(trained_like((4, 4)).to_onnx())
    kept = [t for t in model.graph.initializer if t.name != "bias_1"]
    del model.graph.initializer[:]
    model.graph.initializer.extend(kept)
    with pytest.raises(PolicyFileError, match="bias_1"):
        MlpPolicy.from_onnx(model.SerializeToString())


def test_sizes_are_those_of_the_paper():
    teacher, student = MlpPolicy(10, TEACHER_HIDDEN), MlpPolicy(10, STUDENT_HIDDEN)
    assert (teacher.parameter_count, teacher.macs) == (125_001, 124_300)
    assert (student.parameter_count, student.macs) == (441, 410)


def test_initial_weights_follow_the_seed_and_leave_torchs_generator_alone():
    before = torch.get_rng_state()
    one, same, other = (MlpPolicy(10, (20, 10), seed=s).layers[0].weight for s in (1, 1, 2))
    assert torch.equal(one, same)
    assert not torch.equal(one, other)
    assert torch.equal(before, torch.get_rng_state())


def test_states_of_another_shape_are_refused():
    with pytest.raises(ValueError, match=r"\[N, 10\], not \[3, 9\]"):
        MlpPolicy(10, (4,)).act(np.zeros((3, 9)))


@pytest.mark.parametrize("arguments", [{"window": 0}, {"hidden": ()}, {"hidden": (3, 0)}, {"std": 0.0}, {"mean": math.nan}])
def test_impossible_networks_are_refused(arguments):
    with pytest.raises(ValueError, match="needs"):
        MlpPolicy(**({"window": 10, "hidden": (4, 4)} | arguments))


def test_the_action_joins_the_critic_at_the_second_hidden_layer():
    critic = Critic(10, (400, 300))
    assert [tuple(layer.weight.shape) for layer in critic.layers] == [(400, 10), (300, 400), (1, 300)]
    assert tuple(critic.action.weight.shape) == (300, 1)
    with torch.no_grad():
        critic.action.weight.zero_()
        states = torch.randn(5, 10, generator=torch.Generator().manual_seed(0))
        assert torch.equal(critic(states, torch.zeros(5, 1)), critic(states, torch.ones(5, 1))), "the action has no other way in"
    with pytest.raises(ValueError, match="two hidden layers"):
        Critic(10, (400,))
