"""Annotations and symptom ratings are found by the words of their keys, keep no free text, and are the same before and after redaction."""

from __future__ import annotations

import json
from datetime import UTC, datetime

import pytest

from ml.formats import decode, redact
from ml.formats.percept.annotations import SPEAKS_OF, gather
from ml.formats.percept.words import KEY_WORDS, cleaned, typed
from tests.ml.formats.conftest import PERCEPT_TIME

KEY = b"a key of the clinic's own"
START = datetime.fromisoformat(PERCEPT_TIME.replace("Z", "+00:00"))


def at(seconds: float) -> str:
    return datetime.fromtimestamp(START.timestamp() + seconds, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")


def kept(report):
    return [(round(a.at.timestamp() - START.timestamp()), a.label, a.value, a.under) for a in gather(report).kept]


def test_a_rating_is_an_object_with_a_time_and_a_number_under_a_key_that_speaks_of_ratings():
    report = {
        "SymptomRatings": [
            {"DateTime": at(4), "Symptom": "Tremor", "Rating": 3},
            {"DateTime": at(6), "Tremor": 2, "Rigidity": "1.5"},
            {"Timestamp": int(1000 * (START.timestamp() + 8)), "Severity": 7},
        ]
    }
    assert kept(report) == [
        (4, "tremor", 3.0, "symptom ratings"),
        (6, "rigidity", 1.5, "symptom ratings"),
        (6, "tremor", 2.0, "symptom ratings"),
        (8, "symptom ratings", 7.0, "symptom ratings"),
    ]


def test_annotations_within_a_run_are_placed_by_seconds_or_ticks_of_that_run(percept):
    report = percept.one_run()
    report["BrainSenseTimeDomain"][0]["Annotations"] = [
        {"OffsetInSeconds": 5.0, "Text": "severe tremor, left hand"},
        {"TicksInMs": percept.first_tick + 7000, "Label": "Walking"},
        {"OffsetInMilliSeconds": 9000, "Note": "Ada felt better"},
    ]
    assert kept(report) == [
        (5, "severe tremor left hand", None, "annotations"),
        (7, "walking", None, "annotations"),
        (9, "annotations", None, "annotations"),
    ]
    assert dict(gather(report).lost) == {"texts with other than known words": 1}


def test_what_may_identify_is_not_kept_and_counted():
    report = {
        "ClinicianNotes": [
            {"DateTime": at(1), "MRN": 47, "Value": 4711, "Comment": "born 1990"},
            {"DateOfBirth": "1995-02-03", "Rating": 3},
            {"Ada Lovelace": {"DateTime": at(2), "Score": 5}},
        ]
    }
    found = gather(report)
    assert [(a.label, a.value) for a in found.kept] == [("clinician notes", None), ("clinician notes", 5.0)]
    assert dict(found.lost) == {
        "numbers beyond those of a rating": 1,
        "texts with other than known words": 1,
        "entries without a time": 1,
    }


@pytest.mark.parametrize(
    ("key", "shown"),
    [
        ("BrainSenseAnnotations", "brain sense annotations"),
        ("AdaLovelaceRatings", "… ratings"),
        ("MRN4711", "…"),
        ("Ada Lovelace", "…"),
        ("symptom_ratings", "symptom ratings"),
        ("", "…"),
    ],
)
def test_a_key_is_shown_by_its_technical_words_alone(key, shown):
    assert cleaned(key) == shown
    assert cleaned(shown) == shown, "what was cleaned stays as it is"


def test_a_typed_text_stays_where_all_its_words_are_known():
    assert typed(" Severe tremor, left hand. ") == "severe tremor left hand"
    assert typed("tremor of Ada") is None
    assert typed("x" * 200) is None
    assert SPEAKS_OF <= KEY_WORDS


def full(percept):
    """Build a report with annotations in a section of its own, within a run and below known sections, names among them."""
    report = percept.one_run()
    report["BrainSenseTimeDomain"][0]["AdaAnnotations"] = [{"OffsetInSeconds": 3.0, "Text": "tremor", "Author": "Ada Lovelace"}]
    return report | {
        "SymptomRatings": {"Ada Lovelace": [{"DateTime": at(4), "Symptom": "Tremor", "Rating": 3, "By": "Dr Ockham", "MRN": 4711}]},
        "EventSummary": {"Events": [{"DateTime": at(5), "EventName": "Call Ada"}], "Note": "Ada"},
        "DiagnosticData": {"Comments": [{"DateTime": at(600), "Comment": "lives in Ockham"}]},
        "PatientEvents": {"Initial": [{"EventName": "Tremor", "EventID": 1}], "Final": []},
        "Annotations": [{"DateTime": at(6), "Name": "Ada", "Under": "Lovelace", "Value": 2}],
        "AdaptiveTimelineOfAda": {"x": 1},
    }


def test_the_redacted_report_gives_the_same_annotations_without_names(tmp_path, percept):
    source, target = tmp_path / "r.json", tmp_path / "clean.json"
    report = full(percept)
    source.write_text(json.dumps(report))
    done = redact(source, target, "percept", KEY)
    text = target.read_text()
    assert [s for s in ("Ada", "Lovelace", "Ockham", "4711") if s in text or s in repr(done)] == []
    clean = json.loads(text)
    assert (
        kept(clean)
        == kept(report)
        == [
            (3, "tremor", None, "… annotations"),
            (4, "tremor", 3.0, "symptom ratings"),
            (5, "event summary", None, "event summary"),
            (6, "annotations", 2.0, "annotations"),
            (600, "comments", None, "comments"),
        ]
    )
    again = tmp_path / "again.json"
    redact(target, again, "percept", KEY)
    assert kept(json.loads(again.read_text())) == kept(clean)
    sections = next(said for said in done.removed if said.startswith("sections not known"))
    assert sections.endswith("(1×: adaptive timeline of …)")
    fields = next(said for said in done.removed if said.startswith("fields not known"))
    assert "annotations" not in fields, "what was read is not said to be removed"
    assert next(said for said in done.removed if said.startswith("of annotations")) == (
        "of annotations and ratings: texts with other than known words (6×)"
    )


def test_a_run_has_the_annotations_of_its_time_and_the_history_has_all(tmp_path, percept):
    path = tmp_path / "r.json"
    path.write_text(json.dumps(full(percept)))
    decoded = decode(path)
    (run,) = [r for r in decoded.recordings if r.run == 0 and r.hemisphere == "right"]
    assert [(e.t_s, e.kind, e.label, e.data.get("value")) for e in run.events] == [
        (3.0, "annotation", "tremor", None),
        (4.0, "rating", "tremor", 3.0),
        (5.0, "annotation", "event summary", None),
        (6.0, "rating", "annotations", 2.0),
    ]
    (history,) = [r for r in decoded.recordings if r.run is None]
    assert len(history.events) == 5
    assert "history of the device: 3 annotations, 2 ratings; kept, no session" in decoded.reports[0].understood
    assert "1 entry of PatientEvents without a time: names of events, none that was marked" in decoded.reports[0].ignored


def test_the_real_report_speaks_of_no_annotations(recordings):
    decoded = decode(recordings / "percept/percept_session_report.zip")
    assert {e.kind for r in decoded.recordings for e in r.events} == {"device"}
