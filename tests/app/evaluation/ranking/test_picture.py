"""The picture of the ranking: what candidates ask for, where sessions have been, and what their dose is expected to do."""

from __future__ import annotations

import re
from collections.abc import Callable

from fastapi.testclient import TestClient

from app.evaluation.ranking.picture import SHAPES
from app.platform.web.svg import Plane
from ml.ope.support.behaviour_map import COLUMNS, DOSES, BehaviourMap, Curve
from tests.app.evaluations import judged

PAGE = "/participants/P1/ranking"


def stored_map(policy: int) -> dict[str, object]:
    """A policy that asks for 0.4 of cDBS at every beta, over sessions that held 0.5 to 0.55."""
    curve = Curve((0.4,) * COLUMNS, (0.3,) * COLUMNS, (0.5,) * COLUMNS)
    tried = tuple(tuple(7 if row == 10 else 0 for row in range(DOSES)) for _ in range(COLUMNS))
    edges = tuple(1.0 + 0.1 * k for k in range(COLUMNS + 1))
    return {"policies": {}, "map": BehaviourMap(edges, tried, {str(policy): curve}).to_json()}


def test_lines_limits_and_doses_are_in_milliamperes_with_their_tables(
    client: TestClient, policies: list[int], judge: Callable[..., int]
) -> None:
    behaviour = {"mean_amplitude": 0.4}
    judge({policies[0]: judged(50.0, behaviour=behaviour)}, coverage=stored_map(policies[0]))
    page = client.get(PAGE).text
    assert "Amplitude (mA)" in page
    assert "cDBS 3.0 mA" in page
    assert page.count('fill="var(--c-muted)" fill-opacity=') == COLUMNS, "a cell for every column in which sessions were"
    assert re.search(r'<td>p0</td><td class="num">1\.20?</td>', page), "0.4 of 3 mA"
    assert re.search(r'<td class="num">7</td><td class="num">1\.20?</td>', page)
    assert "evaluate again to see it" not in page


def test_candidates_of_one_verdict_have_shapes_of_their_own() -> None:
    assert len(set(SHAPES)) == len(SHAPES) >= 5
    plane = Plane(0, 0, 100, 100, (0.0, 1.0), (0.0, 1.0))
    for shape in SHAPES:
        plane.mark(10, 10, "accent", shape)
    assert len(set(plane.parts)) == len(SHAPES)


def test_a_ranking_of_before_says_how_to_get_the_figure(client: TestClient, policies: list[int], judge: Callable[..., int]) -> None:
    judge({policies[0]: judged(50.0)})
    assert "evaluate again to see it" in client.get(PAGE).text
