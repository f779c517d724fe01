from __future__ import annotations

import pickle

import numpy as np
import onnx
import pytest
from onnx import TensorProto, helper, numpy_helper

from ml.policies.onnx_policy import OnnxPolicy, PolicyFileError, PolicyOutputError

W = 10


def file(nodes, constants=(), *, given=("N", W), answer=("N", 1), dtype=TensorProto.FLOAT, extra_inputs=(), outputs=None, name="x"):
    graph = helper.make_graph(
        list(nodes),
        "elsewhere",
        [helper.make_tensor_value_info(name, dtype, list(given)), *extra_inputs],
        outputs or [helper.make_tensor_value_info("y", dtype, list(answer))],
        list(constants),
    )
    return helper.make_model(graph, ir_version=8, opset_imports=[helper.make_opsetid("", 17)])


def linear(*, last="Sigmoid", weight=0.01, np_dtype=np.float32, **shape):
    """Build a policy made elsewhere: weighted sum of the window, then `last`."""
    constants = [numpy_helper.from_array(np.full((W, 1), weight, np_dtype), "w")]
    nodes = [helper.make_node("MatMul", ["x", "w"], ["m"]), helper.make_node(last, ["m"], ["y"])]
    kind = TensorProto.FLOAT if np_dtype == np.float32 else TensorProto.DOUBLE
    return file(nodes, constants, dtype=kind, **shape)


def content(model):
    return model.SerializeToString()


def sigmoid(x):
    return 1 / (1 + np.exp(-x))


STATES = np.random.default_rng(1).normal(3.0, 2.0, (7, W))


@pytest.mark.parametrize("np_dtype", [np.float32, np.float64])
@pytest.mark.parametrize("batch", ["N", 1, 3])
def test_a_foreign_policy_answers_whatever_its_batch_size_and_type(np_dtype, batch):
    policy = OnnxPolicy(content(linear(np_dtype=np_dtype, given=(batch, W), answer=(batch, 1))), W)
    answers = policy.act(STATES)
    assert answers.dtype == np.float64
    np.testing.assert_allclose(answers, sigmoid(0.01 * STATES.sum(axis=1)), atol=1e-6)


def test_no_window_gives_no_answer():
    assert OnnxPolicy(content(linear())).act(np.empty((0, W))).shape == (0,)


def test_the_input_may_have_any_name_and_an_open_width_where_the_participant_has_one():
    nodes = [
        helper.make_node("ReduceMean", ["beta oldest first"], ["m"], axes=[1], keepdims=1),
        helper.make_node("Sigmoid", ["m"], ["y"]),
    ]
    model = file(nodes, given=("N", "W"), name="beta oldest first")
    assert OnnxPolicy(content(model), W).window == W
    with pytest.raises(PolicyFileError, match="does not say how many beta amplitudes"):
        OnnxPolicy(content(model))


def test_a_policy_travels_to_another_process():
    policy = OnnxPolicy(content(linear()), W)
    np.testing.assert_array_equal(pickle.loads(pickle.dumps(policy)).act(STATES), policy.act(STATES))


@pytest.mark.parametrize("raw", [b"", b"PK\x03\x04 a zip", b"\x08\x08", b"\xff" * 100])
def test_bytes_that_are_no_network_are_refused(raw):
    with pytest.raises(PolicyFileError, match="not an ONNX file"):
        OnnxPolicy(raw, W)


def test_a_window_of_another_length_is_refused_with_both_numbers():
    with pytest.raises(PolicyFileError, match=r"windows of 10 .* window has 12"):
        OnnxPolicy(content(linear()), 12)


def test_weights_outside_the_file_are_refused():
    model = linear()
    tensor = model.graph.initializer[0]
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="weights.bin")
    with pytest.raises(PolicyFileError, match="'w' lie outside the file"):
        OnnxPolicy(content(model), W)


def test_two_inputs_or_two_outputs_are_refused():
    more = helper.make_tensor_value_info("amplitude", TensorProto.FLOAT, ["N", 1])
    two_in = file([helper.make_node("Sigmoid", ["amplitude"], ["y"])], extra_inputs=[more])
    with pytest.raises(PolicyFileError, match="has 2 and 1"):
        OnnxPolicy(content(two_in), W)
    model = linear()
    model.graph.output.append(helper.make_tensor_value_info("m", TensorProto.FLOAT, ["N", 1]))
    with pytest.raises(PolicyFileError, match="has 1 and 2"):
        OnnxPolicy(content(model), W)


def test_an_input_that_is_also_a_weight_does_not_count():
    model = linear()
    model.graph.input.append(helper.make_tensor_value_info("w", TensorProto.FLOAT, [W, 1]))
    assert OnnxPolicy(content(model), W).act(STATES).shape == (7,)


def test_wrong_shapes_and_types_are_refused():
    with pytest.raises(PolicyFileError, match="3 dimensions"):
        OnnxPolicy(content(file([helper.make_node("Sigmoid", ["x"], ["y"])], given=("N", W, 1), answer=("N", W, 1))), W)
    with pytest.raises(PolicyFileError, match="has 10 columns"):
        OnnxPolicy(content(file([helper.make_node("Sigmoid", ["x"], ["y"])], answer=("N", W))), W)
    whole = file(
        [helper.make_node("Cast", ["x"], ["c"], to=TensorProto.INT64), helper.make_node("Abs", ["c"], ["y"])], dtype=TensorProto.INT64
    )
    with pytest.raises(PolicyFileError, match="INT64"):
        OnnxPolicy(content(whole), W)


def test_an_output_outside_the_range_is_refused_naming_the_value():
    with pytest.raises(PolicyFileError, match=r"answered .*\. Bound the output inside the network") as caught:
        OnnxPolicy(content(linear(last="Relu")), W)
    value = float(str(caught.value).split("answered ")[1].split(" ")[0])
    assert value > 1


def test_an_output_that_is_not_finite_is_refused():
    with pytest.raises(PolicyFileError, match=r"answered -?(nan|inf)"):
        OnnxPolicy(content(linear(last="Log", weight=-1.0)), W)


def test_a_policy_that_draws_random_numbers_is_refused():
    noise = [helper.make_node("RandomUniformLike", ["m"], ["r"]), helper.make_node("Sigmoid", ["r"], ["y"])]
    model = linear()
    del model.graph.node[1]
    model.graph.node.extend(noise)
    with pytest.raises(PolicyFileError, match="draws random numbers"):
        OnnxPolicy(content(model), W)


def test_a_policy_whose_answer_depends_on_the_rest_of_the_batch_is_refused():
    nodes = [
        helper.make_node("MatMul", ["x", "w"], ["m"]),
        helper.make_node("ReduceMean", ["m"], ["mean"], axes=[0], keepdims=1),
        helper.make_node("Sub", ["m", "mean"], ["c"]),
        helper.make_node("Sigmoid", ["c"], ["y"]),
    ]
    with pytest.raises(PolicyFileError, match="other windows of the batch"):
        OnnxPolicy(content(file(nodes, [numpy_helper.from_array(np.full((W, 1), 0.01, np.float32), "w")])), W)


def scaled_sigmoid(factor):
    """Build a file that passes the probe of flat and positive windows only if `factor` times a sigmoid of minus the window is in range."""
    constants = [
        numpy_helper.from_array(np.full((W, 1), -1.0, np.float32), "w"),
        numpy_helper.from_array(np.array([factor], np.float32), "f"),
    ]
    nodes = [
        helper.make_node("MatMul", ["x", "w"], ["m"]),
        helper.make_node("Sigmoid", ["m"], ["s"]),
        helper.make_node("Mul", ["s", "f"], ["y"]),
    ]
    return content(file(nodes, constants))


def test_rounding_is_clipped_and_more_raises_naming_the_window():
    low = np.full((1, W), -100.0)  # no beta amplitude is negative, so loading did not try it
    assert OnnxPolicy(scaled_sigmoid(1 + 5e-5), W).act(low)[0] == 1.0
    policy = OnnxPolicy(scaled_sigmoid(1.01), W)
    with pytest.raises(PolicyOutputError, match=r"1\.01 for window 1"):
        policy.act(np.concatenate([np.ones((1, W)), low]))


def test_a_snapshots_windows_are_tried_on_load():
    with pytest.raises(PolicyFileError, match=r"1\.01"):
        OnnxPolicy(scaled_sigmoid(1.01), W, probe=np.full((1, W), -100.0))


def test_an_unknown_operator_is_refused():
    model = linear(last="Sigmoid")
    model.graph.node[1].op_type = "Stimulate"
    with pytest.raises(PolicyFileError, match="Stimulate"):
        OnnxPolicy(content(model), W)


def test_states_of_another_shape_are_refused():
    with pytest.raises(ValueError, match=r"\[N, 10\]"):
        OnnxPolicy(content(linear()), W).act(np.zeros(W))


def test_the_file_is_kept_as_it_came():
    raw = content(linear())
    assert OnnxPolicy(raw, W).content == raw
    assert onnx.load_model_from_string(raw).graph.name == "elsewhere"
