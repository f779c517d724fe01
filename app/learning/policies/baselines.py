"""Controllers without learning, as policies of a participant, that every ranking compares with its candidates.

They are ONNX files like any other policy, so that they are estimated, bundled and tested in the same way.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import onnx
from numpy.typing import NDArray
from onnx import TensorProto, helper, numpy_helper
from sqlalchemy.orm import Session

from app import __version__
from app.learning import repository
from app.platform import files
from app.tables.learning import BufferSnapshot, Policy
from app.tables.participants import Participant
from ml.policies.from_buffer import proportional_from_buffer
from ml.policies.policy import ProportionalPolicy
from ml.trajectories import ReplayBuffer

CONSTANTS = (1.0, 0.85, 0.7, 0.55, 0.4)
"""Constant amplitude fractions: cDBS, and a grid from which a ranking names the best."""

_OPSET, _IR_VERSION = 17, 8


def ensure_baselines(
    db: Session, participant: Participant, snapshot: BufferSnapshot, buffer: ReplayBuffer, created_by: str
) -> list[Policy]:
    """Return the participant's baseline policies and make missing ones. Constants are made once per window length. Proportional control
    between quantiles of the beta amplitudes (0.25 and 0.9) is made once from the first snapshot in a unit and source of beta. The clone of
    the snapshot's logged behaviour is added where a sweep has made one.
    """
    window = buffer.settings.window
    made = {p.name: p for p in repository.baselines(db, participant.id)}
    suffix = "" if window == 10 else f" (W {window})"
    for fraction in CONSTANTS:
        name = ("cDBS (constant 1.00)" if fraction == 1 else f"constant {fraction:.2f}") + suffix
        if name not in made:
            config = {"controller": "constant", "amplitude": fraction, "window": window}
            made[name] = _add(db, participant, snapshot, name, "constant", config, constant_onnx(fraction, window), created_by)
    name = f"proportional to beta in {snapshot.beta_unit} from {snapshot.beta_source}{suffix}"
    proportional = _proportional(buffer)
    if name not in made and proportional is not None:
        config = {"controller": "proportional", "low": proportional.low, "high": proportional.high, "window": window}
        made[name] = _add(db, participant, snapshot, name, "proportional", config, proportional_onnx(proportional, window), created_by)
    return [
        p
        for p in made.values()
        if p.config.get("window") == window and (p.algorithm == "constant" or p.name == name or p.snapshot_id == snapshot.id)
    ]


def constant_onnx(amplitude: float, window: int) -> bytes:
    """Write a policy file that answers every beta window with the same amplitude fraction."""
    shape = [
        helper.make_node("Shape", ["beta_window"], ["shape"]),
        helper.make_node("Gather", ["shape", "first"], ["count"]),
        helper.make_node("Concat", ["count", "one"], ["answer_shape"], axis=0),
        helper.make_node(
            "ConstantOfShape",
            ["answer_shape"],
            ["amplitude_fraction"],
            value=helper.make_tensor("value", TensorProto.FLOAT, [1], [amplitude]),
        ),
    ]
    return _model(shape, {"first": np.array([0], dtype=np.int64), "one": np.array([1], dtype=np.int64)}, window)


def proportional_onnx(policy: ProportionalPolicy, window: int) -> bytes:
    """Write a policy file of proportional control."""
    gain = (1 - policy.floor) / (policy.high - policy.low)
    nodes = [
        helper.make_node("Slice", ["beta_window", "start", "stop", "axis"], ["newest"]),
        helper.make_node("ReduceMean", ["newest"], ["level"], axes=[1], keepdims=1),
        helper.make_node("Sub", ["level", "low"], ["above"]),
        helper.make_node("Mul", ["above", "gain"], ["rise"]),
        helper.make_node("Add", ["rise", "floor"], ["wish"]),
        helper.make_node("Clip", ["wish", "floor", "top"], ["amplitude_fraction"]),
    ]
    numbers = {"low": policy.low, "gain": gain, "floor": policy.floor, "top": 1.0}
    constants = {name: np.array(value, dtype=np.float32) for name, value in numbers.items()}
    indices = {"start": window - policy.newest, "stop": window, "axis": 1}
    return _model(nodes, constants | {name: np.array([value], dtype=np.int64) for name, value in indices.items()}, window)


def _proportional(buffer: ReplayBuffer) -> ProportionalPolicy | None:
    """Build proportional control for this buffer; None where beta has no spread to be proportional to."""
    try:
        return proportional_from_buffer(buffer)
    except ValueError:
        return None


def _model(nodes: list[onnx.NodeProto], constants: dict[str, NDArray[Any]], window: int) -> bytes:
    graph = helper.make_graph(
        nodes,
        "policy",
        [helper.make_tensor_value_info("beta_window", TensorProto.FLOAT, ["N", window])],
        [helper.make_tensor_value_info("amplitude_fraction", TensorProto.FLOAT, ["N", 1])],
        [numpy_helper.from_array(value, name) for name, value in constants.items()],
    )
    model = helper.make_model(graph, producer_name="betaloop", ir_version=_IR_VERSION, opset_imports=[helper.make_opsetid("", _OPSET)])
    return bytes(model.SerializeToString(deterministic=True))


def _add(
    db: Session,
    participant: Participant,
    snapshot: BufferSnapshot,
    name: str,
    algorithm: str,
    config: dict[str, object],
    content: bytes,
    created_by: str,
) -> Policy:
    row = Policy(
        participant_id=participant.id,
        name=name,
        kind="baseline",
        algorithm=algorithm,
        snapshot_id=snapshot.id if algorithm == "proportional" else None,
        settings_version_id=snapshot.settings_version_id,
        config=config,
        onnx_sha256=files.store(db, content).sha256,
        metrics={},
        code_version=__version__,
        created_by=created_by,
    )
    db.add(row)
    db.flush()
    return row
