"""Policies made elsewhere are programs of strangers: they are judged in a limited child, and run nowhere in the web process."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
import onnx
import psutil
import pytest
from fastapi.testclient import TestClient
from onnx import TensorProto, helper, numpy_helper

from app.learning.policies import constant_onnx
from ml.policies import onnx_policy

WINDOW = 10


def model(nodes: list[Any], initializers: list[Any], **named: Any) -> onnx.ModelProto:
    """Build a model of windows [N, 10] and answers [N, 1] with these nodes, the last of which gives `y`."""
    windows = helper.make_tensor_value_info("x", TensorProto.FLOAT, ["N", WINDOW])
    answers = helper.make_tensor_value_info("y", TensorProto.FLOAT, ["N", 1])
    graph = helper.make_graph(nodes, "policy", [windows], [answers], initializers)
    opsets = [helper.make_opsetid("", 17), *(helper.make_opsetid(domain, 1) for domain in named.get("domains", ()))]
    return helper.make_model(graph, opset_imports=opsets, ir_version=8)


def number(name: str, value: Any, dtype: Any) -> Any:
    return numpy_helper.from_array(np.array(value, dtype=dtype), name)


def half(extra: str) -> list[Any]:
    """Build nodes whose answer is 0.5 + 0 · `extra`, a scalar, for every window."""
    return [
        helper.make_node("Mul", [extra, "zero"], ["nothing"]),
        helper.make_node("ReduceMean", ["x"], ["mean"], axes=[1], keepdims=1),
        helper.make_node("Mul", ["mean", "zero"], ["blank"]),
        helper.make_node("Add", ["blank", "nothing"], ["sum"]),
        helper.make_node("Add", ["sum", "half"], ["y"]),
    ]


CONSTANTS = [number("zero", 0.0, np.float32), number("half", 0.5, np.float32)]


def endless_loop() -> bytes:
    """Build a loop of 2^62 rounds, in a file of some hundred bytes."""
    body = helper.make_graph(
        [
            helper.make_node("Identity", ["go"], ["go_on"]),
            helper.make_node("Add", ["value", "value"], ["next"]),
        ],
        "round",
        [
            helper.make_tensor_value_info("round", TensorProto.INT64, []),
            helper.make_tensor_value_info("go", TensorProto.BOOL, []),
            helper.make_tensor_value_info("value", TensorProto.FLOAT, []),
        ],
        [helper.make_tensor_value_info("go_on", TensorProto.BOOL, []), helper.make_tensor_value_info("next", TensorProto.FLOAT, [])],
    )
    loop = helper.make_node("Loop", ["rounds", "true", "zero"], ["last"], body=body)
    constants = [*CONSTANTS, number("rounds", 2**62, np.int64), number("true", True, np.bool_)]
    return model([loop, *half("last")], constants).SerializeToString()


def constant_of(count: int) -> bytes:
    """Build a constant of so many numbers, in a file of some hundred bytes."""
    fill = helper.make_node("ConstantOfShape", ["count"], ["many"], value=helper.make_tensor("v", TensorProto.FLOAT, [1], [1.0]))
    total = helper.make_node("ReduceMean", ["many"], ["all"], keepdims=0)
    return model([fill, total, *half("all")], [*CONSTANTS, number("count", [count], np.int64)]).SerializeToString()


def weights_outside() -> bytes:
    """Build weights that are to be read from a file of the server."""
    tensor = number("outside", 0.0, np.float32)
    tensor.ClearField("raw_data")
    tensor.data_location = TensorProto.EXTERNAL
    entry = tensor.external_data.add()
    entry.key, entry.value = "location", "../../secrets/pseudonyms"
    return model(half("outside"), [*CONSTANTS, tensor]).SerializeToString()


def claimed_tensor() -> bytes:
    """Build a tensor that claims 2^40 numbers and contains none."""
    tensor = TensorProto(name="huge", data_type=TensorProto.FLOAT, dims=[2**20, 2**20])
    return model([helper.make_node("ReduceMean", ["huge"], ["all"], keepdims=0), *half("all")], [*CONSTANTS, tensor]).SerializeToString()


def custom_operator() -> bytes:
    """Build an operator of a foreign library."""
    node = helper.make_node("Ablate", ["x"], ["other"], domain="org.example")
    return model(
        [node, helper.make_node("ReduceMean", ["other"], ["all"], keepdims=0), *half("all")], CONSTANTS, domains=["org.example"]
    ).SerializeToString()


def post(client: TestClient, content: bytes) -> Any:
    return client.post("/api/v1/participants/P1/policies", data={"name": "theirs"}, files={"file": ("theirs.onnx", content)})


@pytest.mark.slow
@pytest.mark.parametrize(
    ("content", "words"),
    [
        (endless_loop(), "needs more than the 10 s of processor time"),
        (constant_of(400_000_000), "memory"),
        (weights_outside(), "lie outside the file"),
        (claimed_tensor(), "not valid"),
        (custom_operator(), "'Ablate' of 'org.example' is not one of ONNX's own"),
    ],
    ids=["a loop of 2^62", "a constant of 1.6 GB", "external data", "a tensor of 4 TB", "a custom operator"],
)
def test_a_hostile_policy_is_refused_in_words_and_costs_the_service_nothing(
    client: TestClient, participant_code: str, content: bytes, words: str
) -> None:
    assert len(content) < 2000
    before, begun = psutil.Process().memory_info().rss, time.process_time()
    answer = post(client, content)
    assert answer.status_code == 422, answer.text
    assert words in answer.json()["detail"]
    assert client.get("/api/v1/participants/P1/policies").json()["total"] == 0
    assert time.process_time() - begun < 8
    assert psutil.Process().memory_info().rss - before < 100 << 20


def test_the_web_process_runs_no_policy_made_elsewhere(client: TestClient, participant_code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    def never(*_: Any, **__: Any) -> None:
        raise AssertionError("opened in the web process")

    monkeypatch.setattr(onnx_policy.OnnxPolicy, "__init__", never)
    answer = post(client, constant_onnx(0.6, WINDOW))
    assert answer.status_code == 201, answer.text
    policy = answer.json()["id"]
    assert client.get(f"/participants/P1/policies/{policy}", headers={"Accept": "text/html"}).status_code == 200
    assert client.get(f"/participants/P1/policies/{policy}/bundle", headers={"Accept": "text/html"}).status_code == 200
    bundle = client.get(f"/api/v1/policies/{policy}/bundle")
    assert bundle.status_code == 200, bundle.text
    assert bundle.content.startswith(b"PK")
