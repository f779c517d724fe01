"""Markers and names of channels: what stays of them, and what dose they state."""

from __future__ import annotations

import re

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ml.formats.labs.content import measured_samples
from ml.formats.labs.marks import clean_text, parse, render
from ml.formats.labs.names import channel_name, clean_label, clean_unit

KEY = bytes(32)


@pytest.mark.parametrize(
    ("text", "label", "dose"),
    [
        ("stim on 2.5 mA", "stim on 2.5 mA", 2.5),
        ("STIM_ON_2.5mA", "stim on 2.5 mA", 2.5),
        ("amp=1.5mA", "stim 1.5 mA", 1.5),
        ("DBS off left", "stim off left", 0.0),
        ("DBS R 60us 130Hz", "stim right 130 Hz 60 us", None),
        ("stim on", "stim on", None),
        ("3 V", "stim 3 V", None),
        ("L 2.0 mA R 3.0 mA", "note stim", None),
        ("2,5 mA", "note stim", None),
        ("off -0.5 mA", "note stim off", None),
        ("no stim", "note stim", None),
        ("Ada feels tingling at 2.5 mA", "note stim 2.5 mA", None),
        ("S  1", "S 1", None),
        ("New Segment", "new segment", None),
        ("Ada was born 1901-02-03", "marker …", None),
        ("MRN0047110", "marker …", None),
        ("Condition B for Ada: rest", "marker condition … rest", None),
    ],
)
def test_a_marker_states_a_dose_only_in_words_that_are_all_known(text: str, label: str, dose: float | None) -> None:
    kept = clean_text(text, KEY)
    assert re.sub(r" [0-9a-f]{12}", "", kept) == label
    assert parse(text).dose_ma == dose
    assert parse(kept).dose_ma == dose


@given(
    st.one_of(st.text(max_size=60), st.from_regex(r"(stim|dbs|off|on|left|R|Ada|[0-9.]{1,4} ?(mA|V|Hz|us)|[ ,_=-]){0,8}", fullmatch=True))
)
def test_a_cleaned_marker_says_the_same_again(text: str) -> None:
    label = clean_text(text, KEY)
    assert clean_text(label, KEY) == label
    assert parse(label).dose_ma == parse(text).dose_ma
    assert parse(label).mentions == parse(text).mentions
    assert "ada" not in re.sub(r"\b[0-9a-f]{12}\b", "", label.lower())
    assert render(parse(label)) == label


@pytest.mark.parametrize(
    ("label", "of_type", "kind", "side", "contacts"),
    [
        ("LFP_L_01", "", "lfp", "left", (1,)),
        ("STN_R1-R2", "", "lfp", "right", (1, 2)),
        ("LFP R 1-3", "EEG", "lfp", "right", (1, 3)),
        ("STN R +1-3", "", "lfp", "right", (1, 3)),
        ("Fp1", "EEG", "other", None, ()),
        ("C3", "", "other", None, ()),
        ("EMG L", "", "other", "left", ()),
        ("ACC X", "", "acceleration", None, ()),
        ("STIM amplitude", "", "stimulation", None, ()),
        ("Lovelace", "LFP", "lfp", None, ()),
    ],
)
def test_a_name_states_kind_side_and_contacts(label: str, of_type: str, kind: str, side: str | None, contacts: tuple[int, ...]) -> None:
    found = channel_name(label, of_type)
    assert (found.kind, found.side, found.contacts) == (kind, side, contacts)
    if found.text:
        again = channel_name(found.text, of_type)
        assert (again.text, again.side, again.contacts) == (found.text, found.side, found.contacts)


@pytest.mark.parametrize("label", ["Lovelace", "LFP Ada", "L 19010203", "Ada1", "MRN0047110"])
def test_a_name_with_a_word_that_is_on_no_list_does_not_stay(label: str) -> None:
    assert clean_label(label, "LFP", 7) == ("channel 7", False)


@pytest.mark.parametrize(
    ("unit", "spelling"), [("µV", "uV"), ("microvolts", "uV"), ("volts", "V"), ("uA", "uA"), ("Ada", ""), ("mV/K", "")]
)
def test_a_unit_has_one_spelling_or_is_none(unit: str, spelling: str) -> None:
    assert clean_unit(unit) == spelling


def test_a_run_of_three_zeros_is_a_gap_and_two_are_a_signal() -> None:
    x = np.array([1.0, 0, 0, 2, 0, 0, 0, np.nan, 3, np.inf])
    assert measured_samples(x).tolist() == [True, True, True, True, False, False, False, False, True, False]
