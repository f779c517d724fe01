from __future__ import annotations

import numpy as np
import pytest
import torch

from ml.policies.policy import ConstantPolicy, ProportionalPolicy
from ml.rl.distillation import ActionError, DistilConfig, distil, distil_sizes
from ml.rl.networks import MlpPolicy

QUICK = DistilConfig(updates=1500, batch=128)


@pytest.fixture(scope="module")
def teacher(buffer):
    """A network whose answers spread over the range on the buffer's windows."""
    mean, std = buffer.beta_scale()
    policy = MlpPolicy(10, (40, 30), mean=mean, std=std, seed=2)
    with torch.no_grad():
        policy.layers[-1].weight.mul_(500)
    assert policy.act(buffer.transitions().states).std() > 0.1
    return policy


def test_a_student_follows_its_teacher_on_the_buffer_and_around_it(buffer, teacher):
    student = distil(teacher, buffer, QUICK)
    states = buffer.transitions().states
    spread = np.abs(teacher.act(states) - teacher.act(states).mean()).mean()
    assert student.on_buffer.mean < 0.1 * spread
    assert student.on_noise is not None
    assert student.on_noise.mean < 0.2 * spread
    assert (student.parameters, student.macs) == (441, 410)


def test_the_reported_errors_are_those_of_the_student_that_comes_back(buffer, teacher):
    student = distil(teacher, buffer, QUICK)
    states = buffer.transitions().states
    error = sorted(abs(a - b) for a, b in zip(student.policy.act(states), teacher.act(states), strict=True))
    assert student.on_buffer.mean == pytest.approx(sum(error) / len(error))
    assert student.on_buffer.worst == pytest.approx(error[-1])
    place = 0.99 * (len(error) - 1)
    below = int(place)
    assert student.on_buffer.p99 == pytest.approx(error[below] + (place - below) * (error[below + 1] - error[below]))
    assert student.report()["on_buffer"]["worst"] == student.on_buffer.worst


def test_noise_smooths_the_student_beyond_the_buffers_states(buffer, teacher):
    states = np.repeat(buffer.transitions().states, 4, axis=0)
    around = states + np.random.default_rng(5).normal(0, 0.8 * buffer.beta_scale()[1], states.shape)

    def off_the_buffer(sigma):
        student = distil(teacher, buffer, DistilConfig(updates=1500, batch=128, sigma=sigma)).policy
        return ActionError.between(student.act(around), teacher.act(around)).mean

    assert off_the_buffer(0.8) < 0.8 * off_the_buffer(0.0)


def test_without_noise_there_is_no_error_on_noise(buffer):
    student = distil(ConstantPolicy(0.7), buffer, DistilConfig(updates=1000, sigma=0.0))
    assert student.on_noise is None
    assert student.on_buffer.worst < 0.02


def test_any_policy_can_teach_and_any_size_can_learn(buffer):
    low, high = np.quantile(buffer.transitions().states, [0.2, 0.9])
    student = distil(ProportionalPolicy(low, high, newest=3), buffer, DistilConfig(hidden=(30,), updates=1500, batch=128))
    assert student.policy.hidden == (30,)
    assert student.on_buffer.mean < 0.04


def test_the_same_teacher_buffer_and_configuration_give_the_same_student(buffer, teacher):
    config = DistilConfig(updates=130, batch=32)
    before = teacher.to_onnx()
    one, two = distil(teacher, buffer, config), distil(teacher, buffer, config)
    assert one.policy.to_onnx() == two.policy.to_onnx()
    np.testing.assert_array_equal(one.curve["loss"], two.curve["loss"])
    assert one.policy.to_onnx() != distil(teacher, buffer, DistilConfig(updates=130, batch=32, seed=1)).policy.to_onnx()
    assert teacher.to_onnx() == before


def test_progress_is_told_to_the_end(buffer):
    told = []
    distil(ConstantPolicy(0.5), buffer, DistilConfig(updates=250), lambda fraction, message="", **n: told.append((fraction, n["loss"])))
    assert [fraction for fraction, _ in told] == pytest.approx([0.4, 0.8, 1.0])
    assert all(np.isfinite(loss) for _, loss in told)


@pytest.mark.parametrize("wrong", [{"hidden": ()}, {"sigma": -0.1}, {"lr": 0.0}, {"batch": 1}])
def test_impossible_hyper_parameters_are_refused_by_name(wrong):
    with pytest.raises(ValueError, match=next(iter(wrong))):
        DistilConfig(**wrong)


def test_the_comparison_with_the_teacher_is_asked_once_and_reported(buffer):
    teacher, asked = ConstantPolicy(0.4), []

    def agreement(student, of):
        asked.append(of)
        return {"difference": float(student.act(np.full((1, 10), 100.0))[0] - of.act(np.full((1, 10), 100.0))[0])}

    student = distil(teacher, buffer, DistilConfig(updates=300), agreement=agreement)
    assert asked == [teacher]
    assert student.report()["agreement"]["difference"] == student.policy.act(np.full((1, 10), 100.0))[0] - 0.4


def test_students_of_several_sizes_say_what_they_weigh_and_progress_runs_through(buffer, teacher):
    told = []
    config = DistilConfig(updates=200, batch=64)
    students = distil_sizes(teacher, buffer, [(4,), (20, 10)], config, lambda f, message="", **n: told.append((f, message)))
    assert [s.policy.hidden for s in students] == [(4,), (20, 10)]
    assert [s.report()["weight_bytes"] for s in students] == [4 * (44 + 5), 4 * 441]
    assert [f for f, _ in told] == pytest.approx([0.25, 0.5, 0.75, 1.0])
    assert "20 x 10" in told[-1][1]
    assert students[1].policy.to_onnx() == distil(teacher, buffer, config).policy.to_onnx()


def test_a_distillations_configuration_goes_through_json_and_refuses_unknown_names():
    config = DistilConfig(hidden=(8,), sigma=0.1)
    assert DistilConfig.from_json(config.to_json()) == config
    with pytest.raises(ValueError, match="no hyper-parameter gamma"):
        DistilConfig.from_json({"gamma": 0.9})
