"""A threshold is compared with a trace only where its unit and its source are stated."""

from __future__ import annotations

import pytest
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.study import settings
from app.study.sessions.charts import control_chart
from app.study.sessions.pages import summarise
from app.study.sessions.usable_steps import session_data
from app.study.settings_types import SettingsIn
from app.tables.sessions import StudySession


def test_a_threshold_with_stated_unit_and_source_counts(db: Session, study_session: StudySession) -> None:
    data = session_data(db, study_session)
    assert (data.threshold, data.threshold_mismatch) == (1.0, "")
    chart = control_chart(data).figure
    assert "threshold 1 µV" in [t.get("name") for t in chart["data"]]
    assert not any("threshold" in str(a.get("text")) for a in chart["layout"]["annotations"])  # no text over the data


@pytest.mark.parametrize(
    ("left_open", "named"),
    [
        ({"beta_unit": None}, "the unit of"),
        ({"beta_source": None}, "the source of"),
        ({"beta_unit": None, "beta_source": None}, "the unit and the source of"),
    ],
)
def test_without_a_stated_unit_and_source_no_threshold_is_drawn_and_no_share_is_told(
    db: Session, study_session: StudySession, left_open: dict[str, None], named: str
) -> None:
    settings.change_settings(db, study_session.visit.participant, SettingsIn(**left_open), "unknown", SYSTEM)
    data = session_data(db, study_session)
    assert data.threshold is None
    said = f"No person has stated {named} the threshold of 1; this trace is in uV from table."
    assert data.threshold_mismatch == f"{said} State unit and source in the participant's settings."
    assert summarise(data).below_threshold is None
    assert not any("threshold" in str(t.get("name")) for t in control_chart(data).figure["data"])
