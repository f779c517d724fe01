from __future__ import annotations

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ml.formats import DecodeOptions, UndecodableFile, decode, sniff

RATE = 250


def lfp_csv(header="t_s,lfp [uV]", seconds=20.0, rate=RATE, first=0, scale=1.0, decimals=4, gone=(), extra=""):
    k = np.arange(first, int(seconds * rate))
    t = (k + 1) / rate
    x = scale * 3.0 * np.sin(2 * np.pi * 20.0 * t)
    return (
        header
        + "\n"
        + "".join(f"{a:.{decimals}f},{b!r}{extra}\n" for i, (a, b) in enumerate(zip(t.tolist(), x.tolist(), strict=True)) if i not in gone)
    )


def trace(decoded, stream):
    return next(t for t in decoded.recordings[0].traces if t.stream == stream)


@pytest.mark.parametrize(
    ("header", "scale", "options"),
    [
        ("t_s,lfp [uV]", 1.0, {}),
        ("T (s),LFP (mV)", 1e-3, {}),
        ("time,lfp_uV", 1.0, {}),
        (" Time , LFP mV ", 1e-3, {}),
        ("t_s,raw LFP [V]", 1e-6, {}),
        ("t_s,lfp", 1e3, {"table_lfp_unit": "nV"}),
        ("t_s,lfp", 1.0, {"table_lfp_unit": "\u00b5V"}),
    ],
)
def test_beta_of_a_sine_is_its_rms_in_microvolts_whatever_the_stated_unit(write, header, scale, options):
    path = write(lfp_csv(header, scale=scale))
    assert sniff(path) == "csv"
    decoded = decode(path, options=DecodeOptions(**options))
    beta = trace(decoded, "beta")
    assert (beta.unit, beta.source, beta.channel, beta.t_end_first_s) == ("uV", "time_domain", "lfp", 2.0)
    np.testing.assert_allclose(beta.values, 3 / np.sqrt(2), rtol=0.01)
    np.testing.assert_allclose(trace(decoded, "beta_power").values, 4.5, rtol=0.02)
    assert decoded.recordings[0].settings["rate_hz"] == RATE
    (spectrum,) = decoded.recordings[0].spectra
    assert spectrum.hz[np.argmax(spectrum.density)] == 20.0


def test_an_lfp_without_a_unit_is_refused_rather_than_guessed(write):
    with pytest.raises(UndecodableFile, match="states no unit"):
        decode(write(lfp_csv("t_s,lfp")))


def test_the_power_measure_makes_beta_a_power(write):
    decoded = decode(write(lfp_csv()), options=DecodeOptions(beta_measure="power"))
    assert trace(decoded, "beta").unit == "uV2"
    np.testing.assert_allclose(trace(decoded, "beta").values, 4.5, rtol=0.02)
    assert trace(decoded, "beta_rms").unit == "uV"
    with pytest.raises(ValueError, match="beta_measure"):
        DecodeOptions(beta_measure="loudness")


@pytest.mark.parametrize("rate", [200, 250, 500, 1000])
def test_the_rate_is_derived_from_the_times(write, rate):
    decoded = decode(write(lfp_csv(rate=rate, seconds=6.0)))
    assert decoded.recordings[0].settings["rate_hz"] == rate


def test_rounded_times_of_an_odd_rate_give_the_rate_and_not_its_rounding(write):
    decoded = decode(write(lfp_csv(rate=422, seconds=8.0, decimals=3)))
    assert decoded.recordings[0].settings["rate_hz"] == 422


def test_missing_rows_are_gaps_that_cost_their_window_and_are_said(write):
    decoded = decode(write(lfp_csv(gone=range(1100, 1400))))
    # samples 1101 to 1400 lie in (4.4, 5.6] s: 60 % of the third window
    assert trace(decoded, "beta").valid.tolist() == [True, True, False, *[True] * 7]
    assert any("300 samples" in text for text in decoded.reports[0].flagged)


def test_a_window_is_valid_when_it_holds_the_share_of_samples_that_is_asked_for(write):
    text = lfp_csv(gone=range(1100, 1400))
    assert trace(decode(write(text), options=DecodeOptions(min_valid_fraction=0.4)), "beta").valid.all()


def test_rows_before_zero_are_the_lead(write):
    k = np.arange(-500, 1000)
    rows = "".join(f"{(i + 1) / RATE:.3f},{float(np.sin(0.5 * i))!r}\n" for i in k)
    beta = trace(decode(write("t_s,lfp_uV\n" + rows)), "beta")
    assert (beta.t_end_first_s, beta.values.size) == (0.0, 3)
    assert beta.valid.all()


def test_an_amplitude_column_becomes_means_per_step(write):
    text = lfp_csv("t_s,lfp_uV,amplitude (uA)", extra=",1500")
    amplitude = trace(decode(write(text)), "amplitude")
    assert (amplitude.unit, amplitude.source) == ("mA", "table")
    np.testing.assert_allclose(amplitude.values, 1.5)


def test_a_table_without_an_amplitude_says_so(write):
    assert any("no amplitude" in text for text in decode(write(lfp_csv())).reports[0].flagged)


def test_parquet_gives_the_same_recording_as_csv(tmp_path, write, same_recording):
    t = np.arange(1, 2501) / RATE
    x = np.sin(t)
    pq.write_table(pa.table({"t_s": t, "lfp [mV]": x}), tmp_path / "t.parquet")
    rows = "".join(f"{a!r},{b!r}\n" for a, b in zip(t.tolist(), x.tolist(), strict=True))
    assert same_recording(decode(tmp_path / "t.parquet").recordings[0], decode(write("t_s,lfp [mV]\n" + rows)).recordings[0])


def test_a_decimal_comma_is_read(write):
    text = lfp_csv().replace(",", ";").replace(".", ",")
    np.testing.assert_allclose(trace(decode(write(text)), "beta").values, 3 / np.sqrt(2), rtol=0.01)


@pytest.mark.parametrize(
    ("text", "what"),
    [
        (lfp_csv("t_s,lfp [furlong]"), "unknown unit 'furlong' of the LFP column"),
        (lfp_csv(rate=50), "too slowly"),
        (lfp_csv(decimals=1), "times must increase"),
        (lfp_csv(scale=1e7), "more than any electrode"),
        (lfp_csv("t_s,lfp_uV,beta", extra=",1"), "both lfp and beta"),
        ("t_s,lfp_uV\n0.004,1\n", "no signal"),
        ("t_s,lfp_uV\n", "no signal"),
        ("t_s,lfp_uV\n" + "".join(f"{0.1 * k * k:.3f},1\n" for k in range(1, 60)), "evenly"),
        ("t_s,lfp_uV\n" + "".join(f"{k - 100}.0,1\n" for k in range(50)), "no row with t_s > 0"),
        ("t_s,lfp_uV\n" + "".join(f"{k / 250 if k < 99 else 1e9},1\n" for k in range(100)), "Unix seconds"),
        (lfp_csv().replace(",", ",=", 5).replace(",=lfp", ",lfp", 1), "is text"),
        (lfp_csv("lfp_uV,level"), "missing column t_s"),
    ],
)
def test_lfp_that_cannot_be_used_says_why(write, text, what):
    with pytest.raises(UndecodableFile, match=what) as caught:
        decode(write(text))
    assert caught.value.hint
    assert caught.value.where


def test_more_rows_than_allowed_are_refused(write):
    with pytest.raises(UndecodableFile, match="more than 100 rows"):
        decode(write(lfp_csv()), options=DecodeOptions(max_lfp_rows=100))


@given(
    rate=st.integers(150, 400),
    gone=st.lists(st.integers(1, 900), max_size=40, unique=True),
    hz=st.floats(16, 30),
)
def test_any_pattern_of_gaps_leaves_amplitudes_that_are_true_or_missing(tmp_path_factory, rate, gone, hz):
    path = tmp_path_factory.mktemp("t") / "t.csv"
    t = np.arange(1, 6 * rate + 1) / rate
    lost = set(gone)
    rows = [f"{a!r},{float(np.sin(2 * np.pi * hz * a))!r}" for i, a in enumerate(t.tolist()) if i not in lost]
    path.write_text("t_s,lfp_uV\n" + "\n".join(rows))
    decoded = decode(path)
    beta = trace(decoded, "beta")
    assert decoded.recordings[0].settings["rate_hz"] == pytest.approx(rate, rel=1e-6)
    # a stretch of a few cycles is known less well, and never as more than the sine has
    assert np.all(beta.values[beta.valid] < 0.78)
    assert np.all(beta.values[beta.valid] > 0.5)


@pytest.mark.parametrize(("step_s", "gap_s", "what"), [(1e-9, 0.9, "1e\\+09 samples a second"), (2e-5, 0.9, "samples in all")])
def test_no_memory_follows_the_times_of_a_table(write, step_s, gap_s, what):
    times = [k * step_s + gap_s * (k // 20) for k in range(30_000)]
    rows = "".join(f"{t:.9f},1.0\n" for t in times)
    with pytest.raises(UndecodableFile, match=what):
        decode(write("t_s,lfp [uV]\n" + rows))


def test_a_plain_table_of_lfp_is_read_in_blocks(write, monkeypatch):
    monkeypatch.setattr("ml.formats.tables.columns.read_delimited", lambda *_: pytest.fail("read cell by cell"))
    decoded = decode(write(lfp_csv()))
    assert trace(decoded, "beta").valid.all()


@pytest.mark.parametrize("rate", [200, 220, 250])
def test_times_no_finer_than_a_sample_give_the_true_rate_or_are_refused(write, rate):
    """Single precision after nine o'clock, in seconds of the day: steps of 1/256 s."""
    t = np.round((np.arange(30 * rate) + 1) / rate * 256) / 256
    text = "t_s,lfp [uV]\n" + "".join(f"{a:.6f},{np.sin(k):.3f}\n" for k, a in enumerate(t))
    decoded = decode(write(text))
    assert decoded.recordings[0].settings["rate_hz"] == rate
    assert not any("missing" in text for text in decoded.reports[0].flagged)


@pytest.mark.parametrize("rate", [200, 250, 256])
def test_times_in_whole_milliseconds_give_the_true_rate_without_gaps(write, rate):
    text = "t_ms,lfp [uV]\n" + "".join(f"{round(1000 * (k + 1) / rate)},{np.sin(k):.3f}\n" for k in range(20 * rate))
    decoded = decode(write(text))
    assert decoded.recordings[0].settings["rate_hz"] == rate
    assert not any("missing" in text for text in decoded.reports[0].flagged)


@pytest.mark.parametrize("start_s", [150, 1000, 3000])
def test_times_that_count_from_another_moment_are_asked_for(write, start_s):
    text = "t_s,lfp [uV],amplitude_ma\n" + "".join(f"{start_s + k / 250:.4f},{k % 7},2\n" for k in range(5000))
    with pytest.raises(UndecodableFile, match=f"the first row comes {start_s} s after"):
        decode(write(text))
    steps = "t_s,beta,amplitude_ma\n" + "".join(f"{start_s + 2 * k},1,2\n" for k in range(20))
    with pytest.raises(UndecodableFile, match=f"the first row comes {start_s} s after"):
        decode(write(steps))


def test_a_session_whose_first_minutes_are_lost_is_read(write):
    text = "t_s,beta,amplitude_ma\n" + "".join(f"{130 + 2 * k},1,2\n" for k in range(100))
    assert decode(write(text)).recordings[0].duration_s == 328


def join_streams(step_at=10.0, silent=(99.0, 99.0)):
    """Write a table of 250 Hz as public toolboxes do: with an amplitude once in 125 rows, 1 mA and then 2 mA."""
    out = ["t_s,lfp [uV],amplitude_ma"]
    for k in range(20 * 250):
        t = (k + 1) / 250
        given = k % 125 == 0 and not silent[0] <= t < silent[1]
        out.append(f"{t:.3f},{3 * np.sin(2 * np.pi * 20 * t):.4f},{(1.0 if t < step_at else 2.0) if given else 'NaN'}")
    return "\n".join(out)


def test_an_amplitude_once_in_125_rows_is_kept(write):
    decoded = decode(write(join_streams()))
    amplitude = trace(decoded, "amplitude")
    np.testing.assert_allclose(amplitude.values, [1.0] * 5 + [2.0] * 5, atol=0.01)
    assert "amplitude_ma is given once in 125 rows" in repr(decoded.reports[0].understood)
    assert "kept as gaps" not in repr(decoded.reports[0].flagged)


def test_an_amplitude_that_falls_silent_is_unknown_until_it_is_given_again(write):
    amplitude = trace(decode(write(join_streams(silent=(6.0, 12.0)))), "amplitude")
    assert amplitude.valid.tolist() == [True] * 3 + [False] * 3 + [True] * 4
    np.testing.assert_allclose(amplitude.values[amplitude.valid], [1.0] * 3 + [2.0] * 4, atol=0.01)
