"""Delivered dose: what changes it, and what no source vouches for."""

from __future__ import annotations

import json
import zipfile

import numpy as np
import pytest

from ml.formats import decode, redact
from ml.formats.dose import Cycle, Program, delivered_dose

FOLDER = "Session1700000000000/DeviceNPC799999H/"
TWO_MA = Program(True, 2.0, 60.0, (0.0, 3.0))


@pytest.mark.parametrize(
    ("settings", "amplitude", "share"),
    [
        ({"on": True}, 2.0, 1.0),
        ({"on": False}, 0.0, 0.0),
        ({"on": None}, np.nan, np.nan),
        ({"on": True, "cycle": Cycle(60.0, 60.0)}, np.nan, 0.5),
        ({"on": True, "cycle": Cycle(None, None)}, np.nan, np.nan),
        ({"on": True, "cycle": Cycle(60.0, 0.0)}, 2.0, 1.0),
        ({"on": True, "ramp_s": 8.0, "since_on_s": 3.0}, np.nan, np.nan),
        ({"on": True, "ramp_s": 8.0, "since_on_s": 9.0}, 2.0, 1.0),
        ({"on": True, "ramp_s": None, "since_on_s": 9.0}, np.nan, np.nan),
    ],
)
def test_the_dose_follows_everything_that_changes_it_or_is_unknown(settings, amplitude, share):
    dose = delivered_dose(programs=[TWO_MA, Program(False, 8.5, 60.0)], **settings)
    np.testing.assert_equal(dose.amplitude_ma[0], amplitude)
    np.testing.assert_equal(dose.share_on, share)
    assert np.isnan(amplitude) == bool(dose.why)


def test_an_amplitude_beyond_the_clinicians_limits_is_unknown_and_told():
    dose = delivered_dose(True, [Program(True, 4.0, 60.0, (0.0, 3.0))])
    assert np.isnan(dose.amplitude_ma[0])
    assert "3 mA at most" in dose.why[0]


def test_programs_that_stimulate_in_turn_are_told():
    dose = delivered_dose(True, [TWO_MA, Program(True, 1.0, 60.0)])
    assert (dose.amplitude_ma, dose.programs) == ((2.0, 1.0), (0, 1))
    assert "interleaving" in dose.why[0]


def session(rcs, stim, settings=None, seconds=60.0):
    signal = 0.02 * np.sin(2 * np.pi * 22.0 * np.arange(int(seconds * 500)) / 500)
    files = {"DeviceSettings": settings or rcs.settings(), "RawDataTD": rcs.time_domain(signal), "StimLog": stim}
    return {f"{FOLDER}{stem}.json": value for stem, value in files.items() if value is not None}


def log(rcs, *steps):
    first = (-4, {"therapyStatusData": {"therapyStatus": 1, "activeGroup": 0}, **rcs.program(1.0)})
    return rcs.stim(first, *((t, rcs.program(ma)) for t, ma in steps))


def reading(rcs, t_s, amplitude):
    base = rcs.settings()[0]["TherapyConfigGroup0"]
    programs = [{**base["programs"][0], "amplitudeInMilliamps": amplitude}, *base["programs"][1:]]
    (record,) = rcs.stim((t_s, {"TherapyConfigGroup0": {**base, "programs": programs}, "GeneralData": rcs.settings()[0]["GeneralData"]}))
    return record


def amplitude(result):
    (recording,) = result.recordings
    return next((t.values for t in recording.traces if t.stream == "amplitude"), np.full(30, np.nan))


def flags(result):
    return " ".join(text for report in result.reports for text in report.flagged)


@pytest.mark.parametrize("byte", range(1, 400, 7))
def test_a_log_cut_at_any_byte_vouches_for_nothing_behind_the_cut_before_and_after_redaction(rcs, pack, tmp_path, byte):
    true = np.repeat([1.0, 1.5, 2.0], 10)
    text = json.dumps(log(rcs, (20, 1.5), (40, 2.0)))
    path = pack(session(rcs, text[: round(byte / 400 * len(text))]))
    decoded = decode(path)
    redact(path, tmp_path / "r.zip", "rcs", b"k" * 16)
    for found in (decoded, decode(tmp_path / "r.zip")):
        values = amplitude(found)
        known = np.isfinite(values)
        np.testing.assert_allclose(values[known], true[known], atol=1e-6)
        assert not known[-1]
        assert "unknown" in flags(found)
        assert not any("cut" in text for report in found.reports for text in report.repaired)


def test_settings_that_agree_behind_a_cut_say_nothing_of_the_time_between_them(rcs, pack):
    text = json.dumps(log(rcs, (20, 1.5)))[:-40]
    settings = [*rcs.settings(), reading(rcs, 24.3, 2.0), reading(rcs, 50.3, 2.0)]
    values = amplitude(decode(pack(session(rcs, text, settings))))
    assert np.isnan(values[11:]).all()


def test_a_damaged_record_in_the_middle_hides_the_amplitude_until_it_is_stated_again(rcs, pack):
    records = [json.dumps(r) for r in log(rcs, (20, 1.5), (40, 2.0))]
    records[1] = records[1].replace("1.5", "1.5x")
    values = amplitude(decode(pack(session(rcs, "[" + ",".join(records) + "]"))))
    assert np.isnan(values[10:20]).all()


def test_two_sources_that_differ_are_both_told_and_neither_is_believed(rcs, pack):
    settings = [*rcs.settings(), reading(rcs, 30.3, 2.5)]
    decoded = decode(pack(session(rcs, log(rcs, (20, 1.5), (40, 2.0)), settings)))
    values = amplitude(decoded)
    assert np.isnan(values[11:19]).all()
    np.testing.assert_allclose(values[[3, 25]], [1.0, 2.0])
    assert "StimLog says 1.5 mA and DeviceSettings 2.5 mA" in flags(decoded)
    assert len(decoded.recordings[0].quality["amplitude_conflicts"]) == 1


def test_an_upload_without_the_stimulation_log_knows_no_amplitude(rcs, pack):
    settings = [reading(rcs, -5, 2.0), *(reading(rcs, t, 2.0) for t in (20.0, 40.0))]
    settings[0] = {**rcs.settings()[0], **settings[0]}
    decoded = decode(pack(session(rcs, None, settings)))
    assert np.isnan(amplitude(decoded)).all()
    assert "amplitude is unknown" in flags(decoded)


def test_the_real_sweep_has_no_contradiction_and_every_amplitude(recordings):
    recording = decode(recordings / "rcs/stim_sweep.zip").recordings[0]
    assert recording.quality["amplitude_conflicts"] == []
    assert next(t for t in recording.traces if t.stream == "amplitude").valid.all()


def test_the_real_sweep_cut_anywhere_is_never_wrong(recordings, tmp_path):
    """Settings of a real device show some changes a minute late, or never."""
    with zipfile.ZipFile(recordings / "rcs/stim_sweep.zip") as source:
        members = {name: source.read(name) for name in source.namelist()}
    true = amplitude(decode(recordings / "rcs/stim_sweep.zip"))
    for share in (0.3, 0.55, 0.8):
        path = tmp_path / f"{share}.zip"
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as target:
            for name, content in members.items():
                target.writestr(name, content[: int(share * len(content))] if name.endswith("StimLog.json") else content)
        values = amplitude(decode(path))
        known = np.isfinite(values)
        np.testing.assert_allclose(values[known], true[known], atol=0.11)
        assert known.any()
        assert not known.all()
