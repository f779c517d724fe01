"""Policies over a recorded session: what the tablet's loop would have asked for, gaps and all, and how the page says it."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from fastapi.testclient import TestClient

from app.evaluation.policies import replay
from app.evaluation.policies.replay import DifferenceOut, ReplayOut
from app.evaluation.policies.replay_compute import run
from ml.deploy.windows import PolicyWindow
from tests.app.words import above_fold, methods_named

Upload = Callable[..., int]
W = 3


class Rising:
    """Asks for a tenth of the sum of its window."""

    def act(self, states: np.ndarray) -> np.ndarray:
        return states.sum(1) / 10


def test_every_answer_is_to_the_window_before_its_step() -> None:
    beta = [1.0, 2.0, 3.0, 4.0, 0.5]
    assert run(PolicyWindow(Rising(), W), beta, W, 2.0) == pytest.approx([0.6, 0.9])


def test_without_a_whole_window_of_beta_the_loop_is_back_at_cdbs() -> None:
    beta = [1.0, 1.0, 1.0, None, 1.0, 1.0, 1.0, 1.0]
    answers = run(PolicyWindow(Rising(), W), beta, W, 2.0)
    assert answers[0] == pytest.approx(0.3)
    assert answers[1:4] == [None, None, None], "the gap itself, and until three values have come again"
    assert answers[4] == pytest.approx(0.3)


def test_the_route_tells_what_each_would_have_asked_and_how_they_differ(
    client: TestClient, policies: list[int], upload: Upload, client_as: Callable[[str], TestClient]
) -> None:
    session = upload("cdbs", lead=10)
    path, query = "/api/v1/participants/P1/replay", {"session": session, "policy": policies[:2]}
    body = client.get(path, params=query).json()
    for asked, level in zip(body["asked"], (0.4, 0.6), strict=True):
        assert asked["fraction"] == pytest.approx([level] * len(body["t_s"]))
    assert body["recorded_fraction"] == pytest.approx([1.0] * len(body["t_s"]))
    (apart,) = body["differences"]
    assert (apart["mean_fraction"], apart["apart"]) == (pytest.approx(-0.2), 1.0)
    assert [a["energy"] for a in body["asked"]] == pytest.approx([0.16, 0.36])
    assert client_as("blinded_assessor").get(path, params=query).status_code == 403
    assert client.get(path, params={"session": 9999, "policy": policies[0]}).status_code == 404
    page = client.get("/participants/P1/compare", params=query | {"at": 30})
    words = above_fold(page.text)
    assert "Would have asked, not would have happened" in words
    assert "p0 would have asked for 0.6 mA less than p1 on average" in words
    assert "At 1 min 00 s" in words, "without a script the form moves along the session"
    assert methods_named(words) == []


def test_a_policy_of_another_beta_is_not_run_over_it(client: TestClient, policies: list[int], upload: Upload) -> None:
    session = upload("cdbs")
    change = {"settings": {"beta_source": "time_domain"}, "reason": "another source"}
    assert client.put("/api/v1/participants/P1/settings", json=change).status_code == 200
    refused = client.get("/api/v1/participants/P1/replay", params={"session": session, "policy": policies[0]})
    assert (refused.status_code, "takes beta in uV from time_domain" in refused.json()["detail"]) == (422, True)


def test_differences_are_told_in_milliamperes_or_as_shares() -> None:
    common = {"participant": "P1", "session_id": 1, "visit": 1, "period_s": 2.0, "beta_unit": "uV", "t_s": [0.0], "beta": [1.0]}
    numbers = {"fraction": [0.5], "mean_fraction": 0.5, "energy": 0.25, "nearly_off": 0.0}
    asked = [{"policy_id": i, "name": name} | numbers for i, name in ((1, "a"), (2, "b"))]
    apart = DifferenceOut(policy_id=1, other_id=2, mean_fraction=0.1, apart=0.4, most_at_s=92.0, most=-0.5)
    found = ReplayOut.model_validate(
        common | {"cdbs_amplitude_ma": None, "recorded_fraction": [1.0], "asked": asked, "differences": [apart]}
    )
    (sentence,) = replay.differences(found)
    assert sentence == (
        "a would have asked for 10 % of cDBS more than b on average; they are apart in 40 % of the steps, most at 1 min 32 s, "
        "where a asks for 50 % of cDBS less."
    )
    alike = found.model_copy(update={"differences": [apart.model_copy(update={"apart": 0.0})], "cdbs_amplitude_ma": 3.0})
    assert replay.differences(alike) == ["a and b would have asked for the same throughout, within 5 % of the cDBS amplitude."]
