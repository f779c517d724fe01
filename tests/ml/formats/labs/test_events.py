"""Spans of events: where one ends as the next begins, and where a pulse is shorter than their rounding."""

from __future__ import annotations

import numpy as np

from ml.formats.labs.content import Channel, Content
from ml.formats.labs.dose import amplitude_traces
from ml.formats.labs.marks import Mark
from ml.formats.labs.names import channel_name
from ml.formats.labs.timing import even
from ml.formats.options import DecodeOptions
from ml.formats.recording import FileReport


def amplitude(marks: list[Mark]) -> list[float]:
    """Compute the amplitude of 40 s by marks."""
    signal = Channel(channel_name("LFP L 0-2"), "LFP", "uV", even(10_000, 250.0), lambda: np.ones(10_000))
    content = Content("bids", channels=[signal], marks=marks)
    (trace,) = amplitude_traces(content, 0.0, 20, "left", DecodeOptions(), FileReport("file"), {})
    return [float(v) for v in trace.values]


def test_an_end_that_is_rounded_past_the_next_begin_ends_nothing() -> None:
    got = amplitude([Mark(4.0, "stim 1 mA", 10.000001, True), Mark(14.0, "stim 2 mA", 10.0, True)])
    np.testing.assert_allclose(got[2:12], [1.0] * 5 + [2.0] * 5)
    assert np.isnan(got[12:]).all()


def test_a_span_shorter_than_the_rounding_does_not_hold_for_ever() -> None:
    assert np.isnan(amplitude([Mark(4.0, "stim 1 mA", 0.0005, True)])).all()
