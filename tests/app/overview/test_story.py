"""The months of a participant on one axis: every session a dot of its own that leads to the session, changes of settings marked."""

from __future__ import annotations

from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.analysis.evidence.service import evidence
from app.overview.story import story_chart
from app.study import repository
from app.study.repository import participant_by_code
from tests.app.analysis.conftest import adder


def test_every_session_is_a_dot_of_its_own_that_leads_to_it(client: TestClient, db: Session, enrolled: str) -> None:
    add = adder(db, enrolled)
    ids = [add(name, grasp=2.0, visit=visit, medication_h=1.5) for visit in (1, 2) for name in ("cdbs", "rl", "cdbs")]
    add("cdbs", visit=2, excluded="fell asleep")
    assert client.put("/api/v1/participants/P1/settings", json={"settings": {"xi_beta": 1.2}, "reason": "lower"}).status_code == 200
    db.expire_all()
    participant = participant_by_code(db, enrolled, SYSTEM)
    visits, _ = repository.visits(db, participant.id, 100, 0)
    chart = story_chart(evidence(db, participant, SYSTEM), visits, participant.settings)
    assert chart is not None
    panels = {t["name"]: t for t in chart.figure["data"] if "customdata" in t}
    assert set(panels) == {"Beta", "Energy", "Grasp", "Last dose", "Amplitude"}
    grasp = panels["Grasp"]
    assert grasp["customdata"] == [f"/sessions/{i}" for i in ids]
    assert len(set(grasp["x"])) == len(ids)
    # sessions of one visit stay nearer to each other than to any of the next visit
    assert max(grasp["x"][:3]) < min(grasp["x"][3:])
    assert {a["text"] for a in chart.figure["layout"]["annotations"]} == {"settings 2"}
    assert [row[2] for row in chart.rows] == ids
    # below the axis stand the days of the visits, in the middle of their sessions
    axis = chart.figure["layout"]["xaxis"]
    assert axis["ticktext"] == [f"visit {v.number}<br>{v.date}" for v in sorted(visits, key=lambda v: v.number)]
    assert [sorted(grasp["x"][3 * k : 3 * k + 3])[1] for k in (0, 1)] == axis["tickvals"]
