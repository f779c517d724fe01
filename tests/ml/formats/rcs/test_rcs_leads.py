from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ml.formats.rcs.leads import clean_leads, described, hemisphere, sides

UNILATERAL = {"LeadTargets": ["STN", " ", "M1", " "], "LeadLocation": [2, 0, 2, 0]}
BOTH_SIDES = {"LeadTargets": ["GPi", "M1", "GPi", "M1"], "LeadLocation": [2, 2, 1, 1]}


def test_the_side_comes_from_the_leads_behind_the_sensed_channels():
    assert described(UNILATERAL) == ["right STN", "", "right M1", ""]
    assert hemisphere(UNILATERAL, {0, 2}) == "right"
    assert hemisphere(BOTH_SIDES, {0}) == "right"
    assert hemisphere(BOTH_SIDES, {3}) == "left"
    assert hemisphere(BOTH_SIDES, {0, 2}) is None
    assert hemisphere(BOTH_SIDES, ()) is None


@pytest.mark.parametrize("text", ["Left STN", "STN left", "L-STN", "l stn", "STN (L)"])
def test_a_side_in_the_name_of_a_target_is_read_without_a_code(text):
    assert clean_leads({"LeadTargets": [text]})["LeadTargets"][0] == "left STN"
    assert hemisphere({"LeadTargets": [text]}, {0}) == "left"


def test_a_name_and_a_code_that_differ_say_nothing():
    assert sides({"LeadTargets": ["Left STN"], "LeadLocation": [2]})[0] is None


@pytest.mark.parametrize("text", ["Ada Lovelace", "STN Lovelace", "Left", "R", "STN GPi", 5, None, "left right STN", "STN" * 50])
def test_a_word_outside_the_grammar_leaves_no_text(text):
    assert clean_leads({"LeadTargets": [text]}).get("LeadTargets", [""])[0] in ("", "left", "right")


@given(
    st.fixed_dictionaries(
        {"LeadTargets": st.lists(st.sampled_from(["R STN", "Left GPi", "", "Ada"]) | st.text() | st.integers())},
        optional={"LeadLocation": st.lists(st.integers(-1, 4) | st.text()), "ID": st.text()},
    )
)
def test_cleaning_twice_changes_nothing_and_keeps_no_other_field(subject):
    cleaned = clean_leads(subject)
    assert clean_leads(cleaned) == cleaned
    assert set(cleaned) <= {"LeadTargets", "LeadLocation"}
    assert described(cleaned) == described(subject)


@pytest.mark.parametrize("subject", [None, [], "x", {"LeadTargets": "STN"}, {"LeadLocation": 2}])
def test_settings_without_leads_have_no_side(subject):
    assert clean_leads(subject) == {}
    assert hemisphere(subject, {0}) is None
