"""Sessions near a stated amplitude: laid out, bounded, signed, bundled, and taken back by their slot as the random arm."""

from __future__ import annotations

import re
from collections.abc import Callable
from dataclasses import asdict
from typing import Any

import numpy as np
import pytest
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PublicKey
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.planning.plans.designs import Planned, SideBound, delivered_ma
from app.planning.plans.draft_form import held_rows
from app.planning.plans.suggested import Held
from app.planning.plans.wording import design_words
from ml.deploy.bundle import open_bundle
from ml.designs import LOW_AMPLITUDE, LOW_SECONDS, NEAR_SPREAD, Bound, near_session
from ml.ope.posterior.further_sessions import Hold, Place, reachable
from tests.app.planning.plans.test_designs import amplitudes, buffer_of, settle, upload, visit


@pytest.fixture
def number(client: TestClient, participant_code: str) -> int:
    settle(client, cdbs_amplitude_ma=3.0, lower_bound=0.3, xi_beta=1.05)
    return visit(client, 2, date="2099-03-02")


def drafted(client: TestClient, visit_id: int, **more: Any) -> Any:
    return client.post(f"/api/v1/visits/{visit_id}/plan", json={"seed": 5} | more)


def held(body: Any) -> list[dict[str, Any]]:
    return [s for s in body["sessions"] if s["design"] and s["design"]["design"] == "near"]


def test_a_plan_holds_sessions_near_stated_amplitudes_within_the_rules_of_safety(client: TestClient, number: int) -> None:
    wanted = [{"amplitude_ma": 2.1, "sessions": 2}, {"amplitude_fraction": 0.45}]
    body = drafted(client, number, held=wanted, random_sessions=1).json()
    assert [s["controller"] for s in body["sessions"]].count("cdbs") == 1, "a visit without policies has one control"
    assert body["sessions"][0]["controller"] == "cdbs"
    found = held(body)
    assert sorted(s["design"]["level"] for s in found) == pytest.approx([0.45, 0.7, 0.7])
    assert {s["controller"] for s in found} == {"random"}
    assert len({str(s["design"]["holds"]) for s in found}) == 3, "each has draws of its own"
    for s in found:
        design = s["design"]
        steps = np.repeat([h["amplitude"] for h in design["holds"]], [h["steps"] for h in design["holds"]])
        low = np.flatnonzero(steps < LOW_AMPLITUDE)
        assert low.size * 2.0 <= LOW_SECONDS
        assert low.size == 0 or low.min() * 2.0 >= 600 - LOW_SECONDS
        assert np.abs(steps[-100:] - design["level"]).max() <= NEAR_SPREAD + 1e-9
        assert all(h["log_density"] is not None for h in design["holds"])
        assert (s["min_ma"], s["max_ma"]) == (0.9, 3.0)


@pytest.mark.parametrize("lower_bound", [0.2, 1 / 3, 0.45, 0.5, 0.65])
@pytest.mark.parametrize("cdbs_ma", [None, 0.9, 1.7, 2.3, 2.9, 3.1, 4.3])
def test_an_amplitude_that_the_form_proposes_is_one_that_the_plan_takes(lower_bound: float, cdbs_ma: float | None) -> None:
    place = Place(Bound(lower_bound), 300, 2.0)
    near = [found for dose in np.arange(0.45, 1.0, 0.05) if (found := reachable(float(dose), place)) is not None]
    assert near
    for one in near:
        proposed = float(held_rows(None, [Held(Hold(one.level, 1, None), ())], Bound(lower_bound), cdbs_ma)[0].amplitude)
        assert lower_bound <= round(proposed / (cdbs_ma or 1.0), 6) < 1
        assert abs(proposed - one.level * (cdbs_ma or 1.0)) <= 0.1


def test_a_session_near_a_low_amplitude_is_told_to_be_there_in_its_last_minutes_alone() -> None:
    low, high = (Planned("near", level, 1, 0.3, 2.0, near_session(level, 300, 2.0, Bound(0.3), 1, 0).decisions) for level in (0.45, 0.7))
    assert low.holds[0].amplitude > 0.45 + NEAR_SPREAD
    assert design_words(low).endswith("; just above 0.6 until the last 5 min")
    assert "until" not in design_words(high)


def test_drafting_again_draws_the_same_and_another_visit_others(client: TestClient, number: int) -> None:
    wanted = [{"amplitude_ma": 2.1, "sessions": 2}]
    first, again = (sorted(str(s["design"]) for s in held(drafted(client, number, held=wanted, seed=seed).json())) for seed in (1, 2))
    assert first == again
    other = held(drafted(client, visit(client, 3), held=wanted).json())
    assert sorted(str(s["design"]) for s in other) != first


@pytest.mark.parametrize(
    ("wanted", "words"),
    [
        ({"amplitude_ma": 0.8}, "held near 0.8 mA cannot be planned: the participant's lower bound is 0.9 mA, and cDBS 3 mA"),
        ({"amplitude_ma": 3.0}, "held near 3 mA cannot be planned"),
        ({"amplitude_ma": 2.0, "amplitude_fraction": 0.5}, "either amplitude_ma or amplitude_fraction"),
        ({"sessions": 2}, "either amplitude_ma or amplitude_fraction"),
        ({"amplitude_ma": 2.0, "sessions": 9}, "sessions"),
    ],
)
def test_what_the_bound_forbids_is_refused_with_the_bound(client: TestClient, number: int, wanted: Any, words: str) -> None:
    refused = drafted(client, number, held=[wanted])
    assert refused.status_code == 422
    assert words in refused.text


def test_a_limit_above_the_amplitude_and_a_day_too_long_are_refused(client: TestClient, number: int) -> None:
    above = drafted(client, number, held=[{"amplitude_ma": 2.1}], min_ma=2.4)
    assert (above.status_code, "held near 2.1 mA, and the lowest amplitude of the plan is 2.4 mA" in above.text) == (422, True)
    long = drafted(client, number, held=[{"amplitude_ma": 2.1, "sessions": 4}], total_minutes=50)
    assert (long.status_code, "The held sessions with the sessions around them take 70 minutes" in long.text) == (422, True)


def test_milliamperes_need_a_known_cdbs_amplitude_and_fractions_wait_for_it(client: TestClient, number: int) -> None:
    settle(client, cdbs_amplitude_ma=None)
    refused = drafted(client, number, held=[{"amplitude_ma": 2.1}])
    assert (refused.status_code, "The cDBS amplitude of visit 2 is not known" in refused.text) == (422, True)
    body = drafted(client, number, held=[{"amplitude_fraction": 0.7}]).json()
    assert held(body)[0]["design"]["bounds"] == []
    assert "cannot_be_signed" in {w["code"] for w in body["warnings"]}


def test_rounding_keeps_the_minutes_above_the_low_limit_above_it() -> None:
    bound = SideBound(None, 3.2, 1.0, 2.0)
    assert delivered_ma(0.6, bound) == 2.0, "the nearest step of 0.1 mA is 1.9 mA, below 0.6 of 3.2 mA"
    assert delivered_ma(0.59, bound) == 1.9


def test_the_page_the_sheet_and_the_bundle_name_what_is_held(client: TestClient, number: int, sign_plan: Callable[..., Any]) -> None:
    form = {"held_unit": ["amplitude_ma"], "held_amplitude": ["1.5"], "held_sessions": ["2"], "total_minutes": "120"}
    answer = client.post(f"/visits/{number}/plan", data=form, follow_redirects=False)
    assert answer.status_code == 303, answer.text
    words = " ".join(re.sub(r"<[^>]+>", " ", client.get(f"/visits/{number}/plan").text).split())
    assert words.count("Random held near 1.5 mA (0.50 of cDBS)") == 2, "no row of the table counts them as random sessions of the design"
    assert "Random and held sessions" in words
    assert "back to cDBS at once" in words
    assert client.get(f"/api/v1/visits/{number}/plan.pdf").content[:4] == b"%PDF"
    assert sign_plan(number).status_code == 200
    settle(client, beta_unit="uV", beta_source="table", cdbs_amplitude_ma=3.0)
    planned = held(client.get(f"/api/v1/visits/{number}/plan").json())[0]
    answer = client.get(f"/api/v1/visits/{number}/plan/sessions/{planned['position']}/bundle")
    assert answer.status_code == 200, answer.text
    key = Ed25519PublicKey.from_public_bytes(bytes.fromhex(client.get("/api/v1/bundle-key").text.strip()))
    manifest = open_bundle(answer.content, key).manifest
    assert manifest.schedule is not None
    assert (manifest.schedule.design, manifest.schedule.level, manifest.schedule.lower_bound) == ("near", 0.5, 0.3)
    assert [asdict(h) for h in manifest.schedule.holds] == planned["design"]["holds"]
    assert (manifest.min_ma, manifest.max_ma, manifest.policy_name) == (0.9, 3.0, "session held near 0.50 of cDBS")


def test_a_session_that_followed_it_is_kept_with_level_seed_and_density_as_the_random_arm(
    client: TestClient, db: Session, number: int, sign_plan: Callable[..., Any]
) -> None:
    drafted(client, number, held=[{"amplitude_fraction": 0.5, "sessions": 2}])
    assert sign_plan(number).status_code == 200
    design = held(client.get(f"/api/v1/visits/{number}/plan").json())[1]["design"]
    session = upload(client, amplitudes(design))
    kept = client.get(f"/api/v1/sessions/{session}/conditions").json()
    assert (kept["design"], kept["seed"], kept["origin"]) == ("near", design["seed"], "stated")
    assert kept["design_parameters"] == {"level": 0.5, "holds": design["holds"]}
    (logged,) = buffer_of(db).sessions
    assert [h.log_density for h in logged.holds] == [h["log_density"] for h in design["holds"]]
    assert (logged.controller, logged.random_bound) == ("random", 0.3)
    assert "held near 0.50 of cDBS" in client.get(f"/sessions/{session}").text
