"""Rankings for pages to be looked at: predictions and behaviour that follow from a policy's dose, with a spread of chance."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from fastapi.testclient import TestClient

from app.learning.policies import constant_onnx
from ml.ope.support.behaviour_map import COLUMNS, DOSES, BehaviourMap, Curve
from tests.ml.ope.posterior.draws import N

SPREAD = {"energy": 0.02, "grasp_hz": 0.05, "rating": 0.3, "tremor_percent": 2.0}


def made_elsewhere(client: TestClient, doses: Mapping[str, float]) -> list[int]:
    """Ids of policies of P1 that hold a dose, fraction of cDBS, by name."""
    files = [(name, {"file": (f"{name}.onnx", constant_onnx(dose, 10))}) for name, dose in doses.items()]
    answers = [client.post("/api/v1/participants/P1/policies", data={"name": name}, files=file) for name, file in files]
    return [int(answer.json()["id"]) for answer in answers]


def predicted(dose: float, rng: np.random.Generator, nearly_off: float | None = None, **middles: float) -> dict[str, Any]:
    """What is predicted of a policy of some mean dose, and what it does; `middles` replaces outcomes."""
    middle = {"energy": dose**2, "grasp_hz": 2.4 - 0.9 * (1 - dose) ** 2, "rating": 7.2 - 2 * (1 - dose) ** 2}
    middle |= {"tremor_percent": 8 + 60 * (1 - dose) ** 2} | middles
    off = float(dose < 0.2) if nearly_off is None else nearly_off
    return {
        "outcome_draws": {k: np.abs(rng.normal(m, SPREAD[k], N)).round(3).tolist() for k, m in middle.items()},
        "behaviour": {"mean_amplitude": dose, "closeness_to_cdbs": 1 - dose, "below_cdbs_20_percent": off},
    }


def behaviour(doses: Mapping[int, float]) -> dict[str, Any]:
    """What an evaluation stores of policies that go up with beta around their dose, over a cloud of recorded sessions."""
    centre = [1.0 + 0.1 * k for k in range(COLUMNS)]
    tried = tuple(tuple(int(30 * (row % 4 == 0 and row > 6) / (1 + k)) for row in range(DOSES)) for k in range(COLUMNS))
    curves = {str(i): [float(np.clip(d + 0.1 * (b - 2.0), 0, 1)) for b in centre] for i, d in doses.items()}
    shapes = {i: Curve(tuple(c), tuple(v - 0.05 for v in c), tuple(v + 0.05 for v in c)) for i, c in curves.items()}
    apart = {str(i): {str(j): round(abs(d - e), 4) for j, e in doses.items() if j > i} for i, d in doses.items()}
    return {"policies": {}, "map": BehaviourMap((*centre, centre[-1] + 0.1), tried, shapes, apart).to_json()}
