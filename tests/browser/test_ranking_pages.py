"""The ranking and its comparison as a neurologist meets them: the whole answer on the first screen, and a session to move along."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from fastapi.testclient import TestClient
from playwright.sync_api import expect

from tests.app.evaluations import behaviour, judged, made_elsewhere, predicted
from tests.app.evaluations import judge as judge
from tests.ml.ope.posterior.draws import constructed

pytestmark = pytest.mark.browser

DOSES = {"rl-01": 0.74, "rl-02": 0.83, "rl-03": 0.85, "rl-04": 0.91, "rl-05": 0.62, "rl-06": 0.55, "rl-07": 0.97, "rl-08": 0.98}
"""Of each policy, fraction of cDBS; rl-02 and rl-03 do the same, the last two what cDBS does."""
NEARLY_OFF = {"rl-05": 0.26, "rl-06": 0.42}
SCREEN = 900
Judge = Callable[..., int]


@pytest.fixture
def policies(client: TestClient, study_world: list[int]) -> list[int]:
    """Ids of the policies of `DOSES`, for the participant whom `study_world` made."""
    return made_elsewhere(client, DOSES)


@pytest.fixture
def promising(policies: list[int], judge: Judge) -> None:
    """Some are worth a test, some are unsafe, some act like cDBS."""
    rng = np.random.default_rng(5)
    doses = dict(zip(policies, DOSES.values(), strict=True))
    posterior = {
        i: judged(50.0 * d, **predicted(d, rng, NEARLY_OFF.get(name, 0.0))) for (i, d), name in zip(doses.items(), DOSES, strict=True)
    }
    judge(posterior, constructed("cdbs", **predicted(1.0, rng)).to_json(), coverage=behaviour(doses))


@pytest.fixture
def undecided(policies: list[int], judge: Judge) -> None:
    """None is worth a test: of four it is open, the others act like cDBS, and nothing is dangerous."""
    rng = np.random.default_rng(6)
    doses = dict(zip(policies, [d if k < 4 else 0.96 + 0.005 * k for k, d in enumerate(DOSES.values())], strict=True))
    posterior = {i: judged(50.0 * d, **predicted(d, rng, 0.0, **({} if d > 0.95 else {"tremor_percent": 17.2}))) for i, d in doses.items()}
    judge(posterior, constructed("cdbs", **predicted(1.0, rng)).to_json(), coverage=behaviour(doses))


def answered(watched: Any) -> str:
    """Return the answer's words, all of which are on the first screen."""
    watched.signed_in()
    watched.open("/participants/P1/ranking")
    answer = watched.page.locator("#answer")
    box = answer.bounding_box()
    assert box["y"] + box["height"] <= SCREEN, box
    assert watched.page.evaluate("() => scrollY") == 0
    return " ".join(answer.inner_text().split())


def test_the_first_screen_says_what_to_test_what_it_costs_and_what_not_to_touch(window: Callable, promising: None) -> None:  # type: ignore[type-arg]
    words = answered(window(1280, SCREEN))
    first, _, rest = words.partition("Not advised:")
    assert first.count("energy −") == 3, "rl-03 does what rl-02 does"
    assert first.count("grasp ") >= 3
    assert first.count("chance that grasp, rating and tremor all stay within the margins; never run") == 3, "in the same words for each"
    assert "nearly off 26 % of the time" in rest
    assert "nearly off 42 % of the time" in rest
    assert "No worse” is by this participant's margins" in rest


def test_where_nothing_is_worth_a_visit_the_first_screen_says_what_to_do_instead(window: Callable, undecided: None) -> None:  # type: ignore[type-arg]
    words = answered(window(1280, SCREEN))
    assert (
        "By prediction, no policy is worth a visit yet. At the next visit: random and cDBS sessions, from which better policies can"
        in words
    )
    assert "Why: The best of those that may be run is rl-04, energy" in words
    assert "Nor can it be told of 3 more." in words
    assert "a test asks for 80 % likely no worse" in words
    assert "4 act like cDBS, so that a session would show nothing new." in words
    assert "What a random session asks of the patient:" in words
    assert "Not advised: no policy is barred, and none is recommended." in words


def test_a_comparison_is_moved_along_its_session(window: Callable, policies: list[int], study_world: list[int]) -> None:  # type: ignore[type-arg]
    watched = window(1280, SCREEN)
    watched.signed_in()
    watched.open(f"/participants/P1/compare?session={study_world[0]}&policy={policies[0]}&policy={policies[5]}")
    page = watched.page
    slider, time, cells = page.locator("#f-at"), page.locator("[data-scrub-time]"), page.locator("[data-scrub-cell]")
    expect(time).to_have_text("0 min 00 s")
    expect(page.locator("[data-scrub-submit]")).to_be_hidden()
    begin = float(page.get_attribute("[data-cursor]", "x1"))

    slider.focus()
    for _ in range(32):
        page.keyboard.press("ArrowRight")
    # of the table: beta before the step is that of row 32, the amplitude that of row 33
    expect(time).to_have_text("1 min 04 s")
    expect(cells).to_have_text(["2.00", "1.59 mA", "2.22 mA", "1.65 mA"])
    expect(slider).to_have_attribute("aria-valuetext", "1 min 04 s")
    along = float(page.get_attribute("[data-cursor]", "x1"))
    assert along == float(page.get_attribute("[data-cursor]", "x2")) > begin

    for _ in range(20):
        page.keyboard.press("ArrowLeft")
    expect(time).to_have_text("0 min 24 s")
    expect(cells.first).to_have_text("—")  # beta was missing there
    expect(cells.nth(2)).to_have_text("—")  # so that the loop was back at cDBS

    box = slider.bounding_box()
    page.mouse.move(box["x"] + 0.3 * box["width"], box["y"] + box["height"] / 2)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"], box["y"] + box["height"] / 2, steps=5)
    page.mouse.up()
    last = int(slider.get_attribute("max"))
    expect(time).to_have_text(f"{2 * last // 60} min {2 * last % 60:02d} s")
    assert float(page.get_attribute("[data-cursor]", "x1")) > along
    assert watched.errors == []
