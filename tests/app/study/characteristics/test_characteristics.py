"""Characteristics: versioned, without identity, and their hand decides which grasp test counts."""

from __future__ import annotations

import re
from collections.abc import Callable
from html import unescape

import numpy as np
import pytest
from fastapi.testclient import TestClient
from sqlalchemy.orm import Session

from app.accounts.permissions import SYSTEM
from app.platform.errors import Conflict
from app.study import characteristics
from app.study.characteristics import CharacteristicsFields, Lead, Target
from app.study.outcomes import hand
from app.study.outcomes import service as outcomes
from app.tables.participants import Hemisphere, Participant
from app.tables.sessions import StudySession

NewFile = Callable[[StudySession], int]
LEFT, RIGHT = Hemisphere.LEFT, Hemisphere.RIGHT


def state(db: Session, participant: Participant, seen: int = 0, **fields: object) -> None:
    hand.change_characteristics(db, participant, seen, CharacteristicsFields(**fields), "asked", SYSTEM)  # type: ignore[arg-type]


def grasped(db: Session, session: StudySession, file: int, hand: str, hz: float) -> list[str]:
    return outcomes.store_grasp(db, session, file, hand, np.arange(10) / hz, np.zeros(9, dtype=bool))


def test_the_stated_hand_counts_and_not_the_rule(db: Session, study_session: StudySession, new_file: NewFile) -> None:
    file = new_file(study_session)
    grasped(db, study_session, file, "left", 3.0)
    grasped(db, study_session, file, "right", 2.0)
    assert study_session.qoc is not None
    assert study_session.qoc.grasp_hz == pytest.approx(2.0)  # the hemisphere is the left one, and no hand is stated
    assert "the participant's hand is not stated" in (study_session.qoc.reason or "")
    state(db, study_session.visit.participant, hand=LEFT)
    assert study_session.qoc.grasp_hz == pytest.approx(3.0)
    assert "left hand, the participant's by the characteristics (version 1)" in (study_session.qoc.reason or "")


def test_a_test_of_the_other_hand_alone_is_questioned_and_gives_no_value(
    db: Session, study_session: StudySession, new_file: NewFile
) -> None:
    state(db, study_session.visit.participant, hand=LEFT)
    said = grasped(db, study_session, new_file(study_session), "right", 2.0)
    assert study_session.qoc is None
    assert "right hand tested, but the participant's hand is the left one by the characteristics (version 1)" in said[-1]
    state(db, study_session.visit.participant, 1, hand=RIGHT)
    assert study_session.qoc is not None
    assert study_session.qoc.grasp_hz == pytest.approx(2.0)


def test_the_suggested_hand_is_opposite_the_stimulated_side(db: Session, study_session: StudySession) -> None:
    participant = study_session.visit.participant
    assert characteristics.suggested_hand(db, participant) is RIGHT
    study_session.hemisphere = None
    state(db, participant, leads=[Lead(hemisphere=RIGHT, target=Target.STN), Lead(hemisphere=LEFT, target=Target.GPI, stimulating="C+2-")])
    assert characteristics.suggested_hand(db, participant) is RIGHT


def test_versions_follow_each_other_and_two_writers_are_told(db: Session, study_session: StudySession) -> None:
    participant = study_session.visit.participant
    state(db, participant, hand=LEFT)
    state(db, participant, 1, hand=LEFT)  # nothing differs
    assert len(participant.characteristics) == 1
    with pytest.raises(Conflict, match="Another person"):
        state(db, participant, 0, hand=RIGHT)


def test_the_interface_and_the_page_state_them(client: TestClient, participant_code: str) -> None:
    api = f"/api/v1/participants/{participant_code}/characteristics"
    content = {
        "leads": [{"hemisphere": "left", "target": "stn", "model": "3389", "sensing": "0-2", "stimulating": "C+1-"}],
        "symptoms": ["tremor"],
        "hand": "right",
        "medication": [
            {"drug": "levodopa", "mg": 200, "at": "12:00"},
            {"drug": "levodopa", "mg": 100, "at": "07:00"},
        ],
    }
    first = client.put(api, json={"version": 0, "characteristics": content, "reason": "enrolment talk"})
    assert first.status_code == 200, first.text
    assert [d["at"] for d in first.json()["medication"]] == ["07:00", "12:00"]
    refused = client.put(api, json={"version": 1, "characteristics": content | {"leads": [content["leads"][0] | {"model": "Dr. O'Hara"}]}})  # type: ignore[index, operator]
    assert refused.status_code == 422
    page = client.get(f"/participants/{participant_code}/characteristics").text
    form = dict(re.findall(r'<input id="f-(\w+)" name="\w+" type="\w+" value="([^"]*)"', page))
    form |= dict(re.findall(r'<select id="f-(\w+)".*?<option value="([^"]*)" selected', page))
    assert (form["lead1_sensing"], form["hand"], form["dose1_at"], form["dose2_mg"]) == ("0-2", "right", "07:00", "200")
    sent = form | {"version": "1", "symptom_rigidity": "yes", "reason": "looked again"}
    done = client.post(f"/participants/{participant_code}/characteristics", data=sent, follow_redirects=False)
    assert done.headers["location"].endswith("done=changed")
    versions = client.get(api).json()
    assert [v["symptoms"] for v in versions] == [["tremor"], ["rigidity"]]
    assert versions[1]["leads"] == versions[0]["leads"]
    assert versions[1]["medication"] == versions[0]["medication"]
    shown = unescape(client.get(f"/participants/{participant_code}").text)
    assert "left STN, 3389, sensing 0-2, stimulating C+1-" in shown
    stale = client.post(f"/participants/{participant_code}/characteristics", data=sent | {"hand": "left"}, follow_redirects=False)
    assert stale.status_code == 409
    wrong = client.post(f"/participants/{participant_code}/characteristics", data=sent | {"version": "2", "dose1_mg": "much"})
    assert wrong.status_code == 422
    assert "Dose 1, dose" in wrong.text
    wrong = client.post(f"/participants/{participant_code}/characteristics", data=sent | {"version": "2", "lead4_model": "3389"})
    assert (wrong.status_code, "Lead 4, side" in wrong.text) == (422, True)
    assert "More leads" not in wrong.text, "what was typed stays in sight"
    wrong = client.post(f"/participants/{participant_code}/characteristics", data=sent | {"version": "2", "hand": "both"})
    assert (wrong.status_code, len(client.get(api).json())) == (422, 2), "no hand is dropped silently"
