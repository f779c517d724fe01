"""Facts of a recording, whichever decoder wrote it."""

from __future__ import annotations

from typing import Any

from app.study.recordings.charts import Stretch, clock_chart, spectrum_charts, trace_charts
from app.study.recordings.facts import (
    amplitude_limits,
    quality_remarks,
    quality_rows,
    sensing_configurations,
    valid_shares,
)
from app.tables.recordings import Recording


def recording(**details: Any) -> Recording:
    return Recording(id=7, clock="pc", duration_s=100.0, details=details)


def test_packets_left_out_stand_under_their_reason() -> None:
    told = {
        "packets": 2156,
        "missing": 385,
        "loss": 0.1515,
        "chunks": 303,
        "rejected": {"duplicate": 3, "steps_back": 4, "day_off": 1},
        "unusable": 2,
        "flat_share": {"key 0": 0.01},
    }
    [row] = quality_rows(recording(quality={"time_domain": told, "valid_fraction": {"beta key 0": 0.5}, "errors": 2}))
    assert (row.name, row.count, row.missing, row.loss, row.gaps) == ("time domain", 2156, 385, 0.1515, 302)
    assert (row.duplicates, row.late, row.out_of_order, row.clock) == (3, None, None, "pc")
    assert row.remarks == [
        "4 left out: PacketGenTime steps back",
        "1 left out: timestamp more than a day off",
        "2 left out: fields missing or of the wrong kind",
        "share of samples that stand still: key 0 0.01",
    ]


def test_loss_is_told_in_seconds_with_late_and_disordered_packets() -> None:
    told = {
        "packets": 90,
        "missing": 5,
        "missing_s": 1.25,
        "paused_s": 3.0,
        "loss": 0.12,
        "chunks": 3,
        "late": 4,
        "reordered": 2,
        "moved": 1,
    }
    [row] = quality_rows(recording(quality={"accel": told, "clock": {"drift_ppm": 1.0}}))
    assert (row.missing, row.missing_s, row.loss, row.late, row.out_of_order, row.duplicates) == (5, 1.25, 0.12, 4, 2, 0)
    assert row.remarks == ["sensing switched off for 3.0 s in between", "1 under the clock of the next one put back before it"]


def test_the_fit_of_the_clocks_is_drawn_and_stands_nowhere_else() -> None:
    told = {
        "drift_ppm": -60.1, "pc_steps": [[20.3, 10.0]], "implant_steps": [], "residual_t_s": [0.0, 30.0], "residual_ms": [5.0, -40.0],
        "residual_sd_ms": 31.6, "residual_beyond_50_ms": 0.098,
    }  # fmt: skip
    one = recording(quality={"clock": told})
    assert quality_rows(one) == quality_remarks(one) == []
    chart = clock_chart(one)
    assert chart is not None
    assert list(chart.rows) == [[0.0, 5.0], [30.0, -40.0]]
    assert "SD 32 ms, 9.8 % of packets beyond 50 ms · drift -60 ppm" in chart.subtitle
    assert [a["text"] for a in chart.figure["layout"]["annotations"]] == ["PC clock set by +10.0 s"]
    assert clock_chart(recording(quality={})) is None


def test_a_stream_with_one_entry_per_channel_has_a_row_per_channel() -> None:
    told = {"ONE_THREE_RIGHT": {"samples": 51375, "missing_samples": 0, "loss": 0.0, "rate_hz": 250.0, "loss_visible": True}}
    [row] = quality_rows(recording(quality={"time_domain": told}))
    assert (row.name, row.what, row.count, row.missing, row.gaps) == ("time domain ONE THREE RIGHT", "samples", 51375, 0, None)


def test_loss_that_cannot_be_seen_is_not_given_as_no_loss() -> None:
    told = {"packets": 0, "samples": 10, "missing": 0, "loss": 0.0, "loss_visible": False}
    [row] = quality_rows(recording(quality={"time_domain": told}))
    assert (row.missing, row.loss) == (None, None)
    assert "the file gives no packet times: loss cannot be seen" in row.remarks


def test_quality_of_no_stream_is_told_in_words_and_empty_parts_are_not() -> None:
    one = recording(quality={"errors": 2, "spike_packets": {"band 1": 120}, "time_domain": {}, "valid_fraction": {"beta": 0.25}})
    assert quality_rows(one) == []
    assert quality_remarks(one) == [("errors", "2"), ("spike packets", "band 1 120")]
    assert valid_shares(one) == {"beta": 0.25}


def test_limits_of_every_group_and_program_are_listed() -> None:
    limits = {"group A": {"program 0": {"lower_ma": 0.0, "upper_ma": 3.4}}, "group B": {"program 1": {"lower_ma": None, "upper_ma": 5.0}}}
    assert amplitude_limits(recording(limits=limits)) == [("group A program 0", "0 to 3.4 mA"), ("group B program 1", "? to 5 mA")]


def test_a_configuration_replaced_before_the_recording_began_is_left_out_and_repeats_are_too() -> None:
    def state(from_s: float, pair: str, bits: int = 0) -> dict[str, Any]:
        return {"from_s": from_s, "contacts": [pair, "+3-1"], "rates_hz": [250.0, None], "bands": ["band 1", None], "sense_bits": bits}

    found = sensing_configurations(
        recording(settings={"sensing": [state(-9, "+1-0"), state(-1, "+2-0"), state(5, "+2-0"), state(7, "+2-0", bits=4)]})
    )
    assert [(c.from_s, c.channels, c.bands) for c in found] == [
        (-1.0, ["key 0: +2-0 at 250 Hz"], []),
        (7.0, ["key 0: +2-0 at 250 Hz"], ["band 1"]),
    ]


def test_a_recording_that_says_nothing_shows_nothing() -> None:
    bare = recording()
    assert (quality_rows(bare), quality_remarks(bare), valid_shares(bare), amplitude_limits(bare)) == ([], [], {}, [])
    assert sensing_configurations(bare) == []
    assert spectrum_charts(bare, 13, 35) == []
    assert trace_charts(bare, [], Stretch(0, 0, 100)) == []


def test_spectra_of_one_unit_share_a_chart_whose_table_has_every_frequency() -> None:
    first = {"channel": "a", "unit": "uV2/Hz", "hz": [1.0, 2.0], "density": [0.5, None], "seconds": 10.0}
    second = {"channel": "b", "unit": "uV2/Hz", "hz": [2.0, 3.0], "density": [4.0, 5.0], "seconds": 20.0}
    other = {"channel": "c", "unit": "mV2/Hz", "hz": [1.0], "density": [1.0], "seconds": 30.0}
    charts = spectrum_charts(recording(spectra=[first, second, other]), 13, 35)
    assert [c.subtitle for c in charts] == [
        "mV2/Hz · whole recording, gaps left out · signal: c 30 s",
        "uV2/Hz · whole recording, gaps left out · signal: a 10 s; b 20 s",
    ]
    assert list(charts[1].rows) == [[1.0, 0.5, None], [2.0, None, 4.0], [3.0, None, 5.0]]
