"""The picture of the ranking: what candidates ask for, where sessions have been, and what their dose is expected to do."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.evaluation.ranking import picture
from app.evaluation.ranking.picture import DARKEST, MOST, SHAPES, STRIP_W, TONES, make_strips
from app.evaluation.ranking.service import current
from app.learning.policies import constant_onnx
from app.platform.web.svg import Plane
from app.study.margins import margins_of
from app.study.repository import participant_by_code
from ml.ope.support.behaviour_map import COLUMNS, DOSES, BehaviourMap, Curve
from ml.outcomes import OUTCOMES
from tests.app.evaluations import judged
from tests.ml.ope.posterior.draws import N

PAGE = "/participants/P1/ranking"


def stored_map(policy: int) -> dict[str, object]:
    """Build the map of a policy that requests 0.4 of cDBS at every beta, over sessions at 0.5 to 0.55."""
    curve = Curve((0.4,) * COLUMNS, (0.3,) * COLUMNS, (0.5,) * COLUMNS)
    tried = tuple(tuple(7 if row == 10 else 0 for row in range(DOSES)) for _ in range(COLUMNS))
    edges = tuple(1.0 + 0.1 * k for k in range(COLUMNS + 1))
    return {"policies": {}, "map": BehaviourMap(edges, tried, {str(policy): curve}, {}).to_json()}


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


def more_policies(client: TestClient, wanted: int) -> list[int]:
    """Upload further policies made elsewhere, named q0 and on; return their ids."""
    files = [(f"q{k}", {"file": (f"q{k}.onnx", constant_onnx(0.30 + 0.01 * k, 10))}) for k in range(wanted)]
    answers = [client.post("/api/v1/participants/P1/policies", data={"name": name}, files=file) for name, file in files]
    return [int(answer.json()["id"]) for answer in answers]


def test_every_candidate_has_its_dot_and_interval_and_those_like_cdbs_are_grey(
    client: TestClient, policies: list[int], judge: Callable[..., int]
) -> None:
    everyone = [*policies, *more_policies(client, MOST)]
    alike, *others = everyone
    posterior = {i: judged(50.0 - k, behaviour={"mean_amplitude": 0.3 + 0.05 * k}) for k, i in enumerate(others)}
    posterior[alike] = judged(60.0, behaviour={"mean_amplitude": 0.98, "closeness_to_cdbs": 0.02})
    twins = {str(others[0]): {str(others[1]): 0.01}}
    found = stored_map(others[0])["map"]
    curve = found["policies"][str(others[0])]  # type: ignore[index]
    drawn = {**found, "policies": {str(i): curve for i in everyone}, "apart": twins}  # type: ignore[dict-item]
    judge(posterior, coverage={"policies": {}, "map": drawn})
    page = client.get(PAGE).text
    behaviour, doses = re.findall(r'<svg class="drawing".*?</svg>', page, re.S)[:2]
    names = re.findall(r"<title>([pq]\d): [0-9.]+ \([0-9.]+ to [0-9.]+\)</title>", doses)
    panels = 4
    assert {name: names.count(name) for name in names} == dict.fromkeys(("p0", "p1", "p2", *(f"q{k}" for k in range(MOST))), panels)
    assert len(re.findall(r'<line [^>]*stroke-width="1.5"/>', doses)) == panels * len(everyone), "an interval with every dot"
    assert len(re.findall(r'<(?:path|circle|rect)[^>]*fill="var\(--c-muted\)"[^>]*><title>p0:', doses)) == panels, "p0 acts like cDBS"
    assert "grey marks: candidates that act like cDBS" in page
    lines = re.findall(r'<path [^>]*stroke-width="(?:2.5|1.5)" stroke-linejoin', behaviour)
    assert len(lines) == MOST
    assert "the first 8 behaviours with their names, 2 more as thin grey lines" in page, "11 candidates, two of which do the same"
    thin = re.findall(r'<path [^>]*stroke="var\(--c-muted\)" stroke-width="0.75"[^>]*><title>([pq]\d)</title></path>', behaviour)
    assert len(set(thin)) == 2
    assert not any(f">{name}</text>" in behaviour for name in thin), "no names that would hide those of the first"
    assert behaviour.index("0.75") < behaviour.index('stroke-width="2.5"'), "and they lie below"


def test_candidates_like_cdbs_are_drawn_where_there_are_no_others(
    client: TestClient, policies: list[int], judge: Callable[..., int]
) -> None:
    judge({policies[0]: judged(60.0, behaviour={"closeness_to_cdbs": 0.02})}, coverage=stored_map(policies[0]))
    behaviour = re.findall(r'<svg class="drawing".*?</svg>', client.get(PAGE).text, re.S)[0]
    assert 'stroke="var(--c-muted)" stroke-width="1.5" stroke-linejoin' in behaviour
    assert ">p0</text>" in behaviour


def luminance(colour: tuple[float, ...]) -> float:
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in colour]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def contrast(one: tuple[float, ...], other: tuple[float, ...]) -> float:
    high, low = sorted((luminance(one), luminance(other)), reverse=True)
    return (high + 0.05) / (low + 0.05)


def test_lines_and_names_stand_out_in_both_themes_and_on_paper() -> None:
    static = Path(picture.__file__).parents[3] / "static"
    assert "color-scheme: light !important" in (static / "print.css").read_text(), "paper has the light colours"
    pairs = re.findall(r"--c-([a-z_-]+): light-dark\((#[0-9a-f]{6}), (#[0-9a-f]{6})\)", (static / "app.css").read_text())
    for theme in (1, 2):
        colours = {pair[0]: tuple(int(pair[theme][i : i + 2], 16) / 255 for i in (1, 3, 5)) for pair in pairs}
        paper = colours["surface"]
        cell = tuple(DARKEST * a + (1 - DARKEST) * b for a, b in zip(colours["muted"], paper, strict=True))
        for tone in {*TONES.values(), "cdbs"}:
            assert contrast(colours[tone], paper) >= 4.5, f"{tone}: its name is text"
            assert contrast(colours[tone], cell) >= 3.0, f"{tone}: a line over the darkest cell"


def test_a_strip_has_the_margin_on_its_worse_side_and_every_mark_within_its_width(
    client: TestClient, policies: list[int], judge: Callable[..., int], db: Session
) -> None:
    a, b, c = policies
    judge({a: judged(50.0), b: judged(60.0, outcome_draws={"tremor_percent": [45.0] * N}), c: judged(40.0)})
    participant = participant_by_code(db, "P1", SYSTEM)
    found = current(db, participant, SYSTEM).answer
    drawn = make_strips(found, participant.margins_in_force)
    assert {o.field: drawn.limits[o.field] < 0 for o in OUTCOMES} == {o.field: o.higher_is_better for o in OUTCOMES}
    assert drawn.limits["grasp_hz"] == pytest.approx(
        -margins_of(participant.margins_in_force).of(OUTCOMES[0]) * found.under_cdbs["grasp_hz"]
    )
    for row in found.rows:
        for quantity in ("energy", *(o.field for o in OUTCOMES)):
            strip = drawn.draw(row, quantity)
            places = [float(x) for x in re.findall(r'cx="(-?[\d.]+)"|[ML](-?[\d.]+) ', strip) for x in x if x]
            assert len(places) >= 5, "cDBS, the interval and its mark"
            assert all(0 <= x <= STRIP_W for x in places)
            assert ("--c-bad" in strip) == (quantity != "energy" or row.decided.standing == "unsafe"), "energy has no margin"
