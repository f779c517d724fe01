"""The five metrics over REST and as a page."""

from __future__ import annotations

from typing import Any

import pytest
from fastapi.testclient import TestClient
from sqlalchemy import select
from sqlalchemy.orm import Session

from app.tables.participants import Hemisphere
from app.tables.visits import CdbsAmplitude, Visit
from tests.app.words import flat

PATH = "/api/v1/participants/P1/analyses"


def _metric(answer: dict[str, Any], name: str) -> dict[str, Any]:
    return next(m for m in answer["metrics"] if m["metric"] == name)


def _group(metric: dict[str, Any], controller: str) -> dict[str, Any]:
    return next(g for g in metric["groups"] if g["controller"] == controller)


def _comparison(metric: dict[str, Any], controller: str) -> dict[str, Any]:
    return next(c for c in metric["comparisons"] if c["controller"] == controller)


@pytest.fixture
def study_of_ten(add_session) -> None:  # type: ignore[no-untyped-def]
    """Four cDBS, four RL and two no-DBS sessions whose every metric is known by hand."""
    for i in range(4):
        add_session("cdbs", beta=2.0 + 0.1 * i, fraction=1.0 - 0.001 * i, grasp=2.0 + 0.1 * i, rating=8, tremor=5.0 + i)
    for i in range(4):
        add_session(
            "rl", beta=2.05 + 0.1 * i, fraction=0.6 + 0.1 * i, grasp=2.05 + 0.1 * i, rating=8 + i % 2, tremor=5.5 + i, duration_s=600
        )
    for i in range(2):
        add_session("no_dbs", beta=4.0 + i, fraction=0.0, grasp=1.0 + 0.1 * i, rating=3, tremor=60.0)


def test_every_metric_is_grouped_by_controller_and_compared_with_cdbs(client: TestClient, study_of_ten: None) -> None:
    answer = client.get(PATH).json()
    assert [m["metric"] for m in answer["metrics"]] == ["energy", "mean_beta", "grasp", "rating", "tremor"]
    assert (answer["sessions"], answer["excluded"]) == (10, [])
    energy = _metric(answer, "energy")
    assert _group(energy, "rl")["values"] == pytest.approx([0.36, 0.49, 0.64, 0.81], rel=1e-5)
    assert _group(energy, "rl")["median"] == pytest.approx(0.565, rel=1e-5)
    tested = _comparison(energy, "rl")
    assert tested["p_value"] == pytest.approx(2 / 70)
    assert (tested["method"], tested["n_controller"], tested["n_cdbs"]) == ("exact", 4, 4)
    assert tested["low"] <= tested["difference"] <= tested["high"] < 0
    beta = _metric(answer, "mean_beta")
    assert beta["unit"] == "uV"
    assert _group(beta, "cdbs")["values"] == pytest.approx([2.0, 2.1, 2.2, 2.3], rel=1e-5)
    assert _comparison(beta, "rl")["p_value"] == pytest.approx(
        0.6857, abs=1e-3
    )  # 48 of 70 rankings have U at least this far from the middle
    assert _comparison(_metric(answer, "rating"), "rl")["method"] == "exact"


def test_holm_covers_every_test_of_the_page(client: TestClient, study_of_ten: None) -> None:
    answer = client.get(PATH).json()
    made = [c for m in answer["metrics"] for c in m["comparisons"] if c["p_value"] is not None]
    assert len(made) == 5  # no-DBS has too few sessions in all five
    smallest = min(made, key=lambda c: c["p_value"])
    assert smallest["p_holm"] == pytest.approx(5 * smallest["p_value"])
    assert all(c["p_holm"] >= c["p_value"] for c in made)
    assert "covers all 5 comparisons" in answer["limits"][-1]


def test_too_few_sessions_are_named_and_not_tested(client: TestClient, study_of_ten: None) -> None:
    missing = _comparison(_metric(client.get(PATH).json(), "tremor"), "no_dbs")
    assert missing["p_value"] is None
    assert missing["note"].startswith("needs at least 4 sessions on each side; No DBS has 2, cDBS 4")


def test_minutes_and_energy_saving_of_each_controller(client: TestClient, study_of_ten: None) -> None:
    controllers = {c["controller"]: c for c in client.get(PATH).json()["controllers"]}
    assert list(controllers) == ["cdbs", "rl", "no_dbs"]
    assert [c["minutes"] for c in controllers.values()] == [20, 40, 10]
    assert controllers["cdbs"]["energy_saving_percent"] is None
    cdbs = sum((1 - 0.001 * i) ** 2 for i in range(4)) / 4
    assert controllers["rl"]["energy_saving_percent"] == pytest.approx(100 * (1 - 0.575 / cdbs), rel=1e-4)
    assert controllers["no_dbs"]["energy_saving_percent"] == pytest.approx(100)


def test_excluded_and_proposed_sessions_stay_out_and_are_listed(client: TestClient, add_session) -> None:  # type: ignore[no-untyped-def]
    kept = add_session("cdbs")
    dyskinesia = add_session("cdbs", excluded="dyskinesia")
    proposed = add_session("rl", status="proposed")
    answer = client.get(PATH).json()
    assert _group(_metric(answer, "energy"), "cdbs")["session_ids"] == [kept]
    assert [(s["session_id"], s["reason"]) for s in answer["excluded"]] == [(dyskinesia, "dyskinesia"), (proposed, "not confirmed yet")]
    assert [c["controller"] for c in answer["controllers"]] == ["cdbs"]


def test_beta_of_another_unit_or_source_is_not_compared(client: TestClient, add_session) -> None:  # type: ignore[no-untyped-def]
    same = add_session("cdbs", beta=2.0)
    add_session("cdbs", beta=900.0, unit="device units", source="device_power")
    add_session("rl", beta=800.0, unit="device units", source="device_power")
    beta = _metric(client.get(PATH).json(), "mean_beta")
    assert _group(beta, "cdbs")["session_ids"] == [same]
    assert _group(beta, "rl")["n"] == 0
    assert beta["notes"] == ["2 sessions in device units (device_power) left out: only beta in uV (table) is compared."]
    assert _comparison(beta, "rl")["note"] == "needs at least 4 sessions with this metric on each side; RL has 0, cDBS 1"


def test_where_no_session_has_the_settings_unit_the_most_frequent_is_taken(client: TestClient, add_session) -> None:  # type: ignore[no-untyped-def]
    for _ in range(2):
        add_session("cdbs", beta=900.0, unit="device units", source="device_power")
    add_session("rl", beta=3.0, unit="mV", source="time_domain")
    beta = _metric(client.get(PATH).json(), "mean_beta")
    assert (beta["unit"], _group(beta, "cdbs")["n"], _group(beta, "rl")["n"]) == ("device units", 2, 0)


def test_a_session_half_unknown_has_no_energy_and_no_mean_beta(client: TestClient, add_session) -> None:  # type: ignore[no-untyped-def]
    nan = float("nan")
    add_session("cdbs", beta=[nan] * 76 + [2.0] * 74, fraction=[nan] * 76 + [1.0] * 74)
    enough = add_session("cdbs", beta=[nan] * 75 + [2.0] * 75, fraction=[nan] * 75 + [0.5] * 75)
    answer = client.get(PATH).json()
    for name, value in (("energy", 0.25), ("mean_beta", 2.0)):
        group = _group(_metric(answer, name), "cdbs")
        assert (group["session_ids"], group["values"]) == ([enough], [value])
    assert _metric(answer, "energy")["notes"] == ["1 session without this metric."]


def test_a_session_that_cannot_be_read_does_not_stop_the_others(client: TestClient, db: Session, add_session) -> None:  # type: ignore[no-untyped-def]
    kept, unclear = add_session("cdbs", hemisphere="left"), add_session("cdbs")
    visit = db.scalars(select(Visit)).one()
    db.add_all(CdbsAmplitude(visit_id=visit.id, hemisphere=side, program=0, amplitude_ma=3.0) for side in Hemisphere)
    db.commit()
    answer = client.get(PATH).json()
    assert _group(_metric(answer, "energy"), "cdbs")["session_ids"] == [kept]
    assert [s["session_id"] for s in answer["excluded"]] == [unclear]
    assert "cannot be read: No hemisphere is named" in answer["excluded"][0]["reason"]


def test_a_participant_without_sessions_has_an_empty_analysis(client: TestClient, participant_code: str) -> None:
    answer = client.get(PATH).json()
    assert (answer["sessions"], answer["controllers"]) == (0, [])
    assert all(m["groups"] == [] and m["comparisons"] == [] for m in answer["metrics"])
    assert "at least one confirmed session" in client.get("/participants/P1/analyses").text


def test_the_page_shows_charts_tables_tests_and_limits(client: TestClient, study_of_ten: None) -> None:
    page = client.get("/participants/P1/analyses/paper", headers={"Accept": "text/html"})
    assert page.status_code == 200
    assert page.text.count("data-chart") == 5
    for words in (".029", "too few", "not independent", "Hodges-Lehmann", "exact", "covers all 5 comparisons"):
        assert words in page.text
    assert "<b>Not enough data</b> for 5 of 10 comparisons" in flat(page.text)


def test_only_who_may_read_the_participant_sees_the_analysis(service_app, participant_code: str) -> None:  # type: ignore[no-untyped-def]
    assert TestClient(service_app).get(PATH).status_code == 401


def test_sessions_whose_amplitudes_contradict_their_controller_are_named_and_count(client: TestClient, add_session) -> None:  # type: ignore[no-untyped-def]
    for controller, fraction in (("cdbs", 0.95), ("cdbs", 1.05), ("no_dbs", 0.04), ("rl", 0.5)):
        add_session(controller, fraction=fraction)
    add_session("cdbs", fraction=None)
    wrong = {
        add_session("cdbs", fraction=0.5): ("cdbs", 0.5),
        add_session("cdbs", fraction=1.2): ("cdbs", 1.2),
        add_session("no_dbs", fraction=0.9): ("no_dbs", 0.9),
    }
    answer = client.get(PATH).json()
    assert {w["session_id"]: (w["controller"], pytest.approx(w["mean_fraction"], abs=1e-5)) for w in answer["warnings"]} == wrong
    assert answer["sessions"] == 8
    for path in ("/participants/P1/analyses/paper", "/participants/P1"):
        page = client.get(path, headers={"Accept": "text/html"}).text
        assert "Sessions whose amplitudes contradict their controller" in page
        assert "mean amplitude fraction is 1.20; 0.9 to 1.1 is expected" in page


def test_a_participant_without_cdbs_sessions_has_a_page_that_says_so(client: TestClient, participant_code: str) -> None:
    table = b"t_s,beta,amplitude_fraction\n0,1,1\n2,1,0.5\n4,1,0.6\n"
    data = {"participant": participant_code, "visit": "1", "controller": "random"}
    assert client.post("/api/v1/uploads", data=data, files={"file": ("s.csv", table)}).status_code == 201
    for path in ("/participants/P1/analyses/paper", "/participants/P1"):
        page = client.get(path, headers={"Accept": "text/html"})
        assert page.status_code == 200
        assert "cDBS 0" in page.text
