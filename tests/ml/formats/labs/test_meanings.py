"""Meanings that a lab states of its markers and channels: one answer for the same words, no dose where none is stated."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from ml.formats import DecodedFile, DecodeOptions, decode, redact
from ml.formats.labs.marks import clean_text, parse
from ml.formats.labs.meanings import Meaning
from tests.ml.formats.peers.xdf import Stream, write

KEY = bytes(32)


def lfp(seconds: float = 40.0) -> Stream:
    t = np.arange(int(seconds * 250)) / 250
    x = 5 * np.sin(2 * np.pi * 20 * t)[:, None] + np.random.default_rng(0).normal(0, 1, (t.size, 1))
    return Stream("LFP", "LFP", 250.0, 100.0 + t, x, ["LFP L 0-2"], ["uV"])


def marks(*texts: tuple[float, str]) -> Stream:
    return Stream("Markers", "Markers", 0, np.array([100.0 + t for t, _ in texts]), [s for _, s in texts], form="string", per_chunk=1)


def read(path: Path, *streams: Stream, **meanings: object) -> DecodedFile:
    write(path, [lfp(), *streams])
    redact(path, path.with_suffix(".clean"), "xdf", KEY)
    return decode(path.with_suffix(".clean"), "xdf", DecodeOptions(meanings=meanings))  # type: ignore[arg-type]


def amplitude(file: DecodedFile) -> list[float | None]:
    found = [t for t in file.recordings[0].traces if t.stream == "amplitude"]
    return [None if np.isnan(v) else float(v) for v in found[0].values] if found else []


def key_of(text: str) -> str:
    return parse(clean_text(text, KEY)).key


def test_an_unknown_marker_is_asked_once_and_its_meaning_gives_the_dose(tmp_path: Path) -> None:
    said = marks((10, "Plantedname cond A"), (20, "plantedname  COND a"), (24, "stim off"))
    found = read(tmp_path / "a.xdf", said)
    (question,) = found.recordings[0].quality["questions"]
    assert (question["shown"], question["count"], question["first_s"], question["asked"]) == ("… a", 2, 10.0, False)
    assert amplitude(found)[:12] == [None] * 12
    again = read(tmp_path / "a.xdf", said, **{question["key"]: {"means": "amplitude", "amplitude_ma": 2.5}})
    assert again.recordings[0].quality["questions"] == []
    assert amplitude(again)[:5] == [None] * 5
    assert amplitude(again)[6:12] == [2.5] * 6
    assert amplitude(again)[13:] == [0.0] * 7
    assert found.recordings[0].fingerprint == again.recordings[0].fingerprint


@pytest.mark.parametrize(
    ("text", "meaning", "dose"),
    [
        ("DBS R 60us 130Hz", {"means": "amplitude", "amplitude_ma": 3.0}, 3.0),
        ("Medtronic B 2.5 mA", {"means": "stated"}, 2.5),
        ("L 2.0 mA R 3.0 mA", {"means": "stated"}, None),
        ("3 V", {"means": "stated"}, None),
        ("stim on", {"means": "stated"}, None),
        ("S  7", {"means": "off"}, 0.0),
        ("ramp 2.5 mA", {"means": "unknown"}, None),
        ("ramp 2.5 mA", {"means": "nothing"}, None),
    ],
)
def test_a_meaning_states_no_more_than_a_person_did(text: str, meaning: dict[str, object], dose: float | None) -> None:
    found = parse(clean_text(text, KEY))
    assert found.key
    stated = Meaning(**meaning).apply(found)  # type: ignore[arg-type]
    assert stated.dose_ma == dose
    assert stated.mentions == (meaning["means"] != "nothing")


def test_between_two_stated_amplitudes_nothing_is_guessed(tmp_path: Path) -> None:
    said = marks((4, "2.0 mA"), (14, "cond ramp"), (24, "3.0 mA"))
    unknown = {key_of("cond ramp"): {"means": "unknown"}}
    assert amplitude(read(tmp_path / "a.xdf", said, **unknown))[8:12] == [None] * 4
    assert amplitude(read(tmp_path / "a.xdf", said, **unknown))[13:] == [3.0] * 7


def test_quantities_do_not_make_other_words_and_other_words_do() -> None:
    assert key_of("Ada level 2.5 mA") == key_of("ada LEVEL 3 mA")
    assert key_of("Ada level 2.5 mA") != key_of("Eve level 2.5 mA")
    assert key_of("cond 1") != key_of("cond 2")
    assert key_of("stim on 2.5 mA") == ""
    assert key_of("New Segment") == ""


@pytest.mark.parametrize(("unit", "dose"), [("mA", 2.0), ("uA", 0.002), ("V", None)])
def test_the_unit_of_an_amplitude_channel_is_asked(tmp_path: Path, unit: str, dose: float | None) -> None:
    t = np.arange(40 * 10) / 10
    stim = Stream("Stim", "Stimulation", 10.0, 100.0 + t, np.full((t.size, 1), 2.0), ["stim L"], [""])
    found = read(tmp_path / "a.xdf", stim)
    (question,) = found.recordings[0].quality["questions"]
    assert question["asked"]
    assert amplitude(found) == []
    again = amplitude(read(tmp_path / "a.xdf", stim, **{question["key"]: {"means": "unit", "unit": unit}}))
    assert again[3:15] == ([] if dose is None else pytest.approx([dose] * 12))


@pytest.mark.parametrize(
    "wrong",
    [
        {"means": "amplitude"},
        {"means": "off", "amplitude_ma": 1.0},
        {"means": "amplitude", "amplitude_ma": 26.0},
        {"means": "amplitude", "amplitude_ma": -1.0},
        {"means": "unit", "unit": "Hz"},
        {"means": "louder"},
    ],
)
def test_a_meaning_that_contradicts_itself_is_refused(wrong: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=r"amplitude|unit"):
        Meaning(**wrong)  # type: ignore[arg-type]
