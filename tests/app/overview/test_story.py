"""The months of a participant on one axis: every session a dot of its own that leads to the session, changes of settings marked."""

from __future__ import annotations

import datetime as dt

from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.analysis.evidence import evidence
from app.overview.story import story_chart
from app.platform.web.charts import ACCENT, Chart, Link
from app.study import repository
from app.study.repository import participant_by_code
from app.tables.visits import Visit
from tests.app.analysis.conftest import adder

LATER = dt.date(2026, 6, 1)
"""After every visit of these tests but those that they date themselves."""


def drawn(db: Session, code: str, today: dt.date = LATER) -> Chart:
    db.expire_all()
    participant = participant_by_code(db, code, SYSTEM)
    visits, _ = repository.visits(db, participant.id, 100, 0)
    chart = story_chart(evidence(db, participant, SYSTEM), visits, participant.settings, today)
    assert chart is not None
    return chart


def test_every_session_is_a_dot_of_its_own_that_leads_to_it(client: TestClient, db: Session, participant_code: str) -> None:
    add = adder(db, participant_code)
    ids = [add(name, grasp=2.0, visit=visit, medication_h=1.5) for visit in (1, 2) for name in ("cdbs", "rl", "cdbs")]
    add("cdbs", visit=2, excluded="fell asleep")
    assert client.put("/api/v1/participants/P1/settings", json={"settings": {"xi_beta": 1.2}, "reason": "lower"}).status_code == 200
    chart = drawn(db, participant_code)
    visits, _ = repository.visits(db, 1, 100, 0)
    panels = {t["name"]: t for t in chart.figure["data"] if "customdata" in t}
    assert set(panels) == {"Beta", "Energy", "Grasp", "Last dose", "Amplitude"}
    grasp = panels["Grasp"]
    assert grasp["customdata"] == [f"/sessions/{i}" for i in ids]
    assert len(set(grasp["x"])) == len(ids)
    # sessions of one visit stay nearer to each other than to any of the next visit
    assert max(grasp["x"][:3]) < min(grasp["x"][3:])
    assert {a["text"] for a in chart.figure["layout"]["annotations"]} == {"settings 2"}
    assert [row[2] for row in chart.rows] == [Link(i, f"/sessions/{i}") for i in ids]
    # below the axis are the days of the visits, in the middle of their sessions
    axis = chart.figure["layout"]["xaxis"]
    assert axis["ticktext"] == [f"visit {v.number}<br>{v.date}" for v in sorted(visits, key=lambda v: v.number)]
    assert [sorted(grasp["x"][3 * k : 3 * k + 3])[1] for k in (0, 1)] == axis["tickvals"]


def test_every_dated_visit_is_marked_also_without_a_session_and_the_next_one_told_apart(db: Session, participant_code: str) -> None:
    add = adder(db, participant_code)
    add("cdbs", grasp=2.0, visit=1)
    add("cdbs", visit=2, excluded="fell asleep")
    planned = Visit(participant_id=1, number=7, date=dt.date(2026, 8, 3))
    db.add_all([planned, Visit(participant_id=1, number=8, date=dt.date(2026, 9, 7)), Visit(participant_id=1, number=9)])
    db.commit()
    chart = drawn(db, participant_code)
    layout = chart.figure["layout"]
    assert [text.split("<br>")[0] for text in layout["xaxis"]["ticktext"]] == ["visit 1", "visit 2", "visit 7", "visit 8"]
    lines = {line["x0"][:10]: line["line"]["color"] for line in layout["shapes"]}
    assert sorted(lines) == ["2026-03-02", "2026-03-30", "2026-08-03", "2026-09-07"]
    assert [day for day, ink in lines.items() if ink == ACCENT] == ["2026-08-03"]
    (label,) = layout["annotations"]
    assert (label["text"], label["x"][:10]) == ("next visit: 7", "2026-08-03")
    # the axis reaches to all of them, for a chart looks at no line when it chooses what to show
    low, high = layout["xaxis"]["range"]
    assert low < min(line["x0"] for line in layout["shapes"])
    assert high > max(line["x0"] for line in layout["shapes"])
    words = [row[:2] for row in chart.rows if row[2] is None]
    assert words[1:] == [
        ["2026-08-03 (next visit)", Link(7, f"/visits/{planned.id}")],
        ["2026-09-07", Link(8, f"/visits/{planned.id + 1}")],
    ]
    assert not any("next visit" in a["text"] for a in drawn(db, participant_code, dt.date(2026, 12, 1)).figure["layout"]["annotations"])


def test_dated_visits_are_shown_before_any_session_counts(client: TestClient, db: Session, participant_code: str) -> None:
    participant = participant_by_code(db, participant_code, SYSTEM)
    assert story_chart(evidence(db, participant, SYSTEM), [Visit(participant_id=1, number=1)], participant.settings, LATER) is None
    db.add_all([Visit(participant_id=1, number=k, date=dt.date(2026, 6 + k, 3)) for k in (2, 3)])
    db.commit()
    db.expire_all()
    adder(db, participant_code)("cdbs", visit=2, excluded="fell asleep")
    chart = drawn(db, participant_code)
    layout = chart.figure["layout"]
    assert [text.split("<br>")[0] for text in layout["xaxis"]["ticktext"]] == ["visit 1", "visit 2", "visit 3"]
    assert [a["text"] for a in layout["annotations"]] == ["next visit: 2"]
    assert [row[1].text for row in chart.rows if isinstance(row[1], Link)] == [1, 2, 3]
    assert chart.subtitle == "n = 0 sessions \u00b7 3 visits with a date"
    assert 'id="story"' in client.get("/participants/P1").text


def test_sessions_without_any_value_keep_their_visits_on_the_axis(db: Session, participant_code: str) -> None:
    adder(db, participant_code)("cdbs", visit=2, beta=None, fraction=None)
    chart = drawn(db, participant_code)
    assert not any("customdata" in trace for trace in chart.figure["data"])
    assert [text.split("<br>")[0] for text in chart.figure["layout"]["xaxis"]["ticktext"]] == ["visit 1", "visit 2"]


def test_the_table_of_the_months_leads_to_sessions_without_a_mouse(client: TestClient, db: Session, participant_code: str) -> None:
    session = adder(db, participant_code)("cdbs", grasp=2.0)
    story = client.get("/participants/P1").text.split('id="story"')[1].split("</figure>")[0]
    assert f'<td class="num"><a href="/sessions/{session}">{session}</a></td>' in story
