"""Two hundred jobs asked for, one request each."""

from __future__ import annotations

import time
from collections.abc import Callable

import pytest
from fastapi.testclient import TestClient

JOBS = "/api/v1/participants/P1/jobs"
MANY = 200


@pytest.mark.slow
def test_a_request_for_a_job_costs_the_same_however_many_wait(client: TestClient, upload: Callable[..., int]) -> None:
    upload("random")

    def cost(first: int, count: int) -> float:
        begun = time.process_time()
        for seed in range(first, first + count):
            asked = {"kind": "train", "preset": "quick", "seed": seed, "bulk": True}
            assert client.post(JOBS, json=asked).status_code == 202
        return (time.process_time() - begun) / count

    early = cost(0, 20)
    cost(20, MANY - 40)
    late = cost(MANY - 20, 20)
    assert late < 3 * early + 0.02, f"{early:.3f} s, then {late:.3f} s"
