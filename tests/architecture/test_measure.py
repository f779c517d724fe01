"""The measures of the redesign may only fall, and what fell is recorded."""

from __future__ import annotations

import pytest

from tests.architecture import measure


def test_no_measure_rises() -> None:
    values = {name: value for name, value in measure.current()["measures"].items() if not name.startswith(measure.TRACED)}
    details = {name: found for name, (_, found) in measure.measurements().items()}
    assert measure.unlike_record(values, details=details) == []


def test_every_measure_is_recorded() -> None:
    assert set(measure.ratchet()["measures"]) == set(measure.MEASURES)


def test_a_rise_is_refused_and_a_fall_must_be_recorded() -> None:
    now = measure.ratchet()["measures"]["tables by string"]
    assert measure.unlike_record({"tables by string": now}) == []
    rose = measure.unlike_record({"tables by string": now + 1}, details={"tables by string": ["here"]})
    assert rose == [f"measures may only fall: tables by string: {now} -> {now + 1}\ntables by string: here"]
    (fell,) = measure.unlike_record({"tables by string": now - 1})
    assert fell.startswith(f"measures fell: tables by string: {now} -> {now - 1}. Record it: ")
    assert measure.unlike_record({"tables by string": now - 1}, exact=False) == []


def test_lines_are_recorded_in_steps() -> None:
    assert measure.differences({"lines of product": 1000}, {"lines of product": 501}) == ([], [])
    assert measure.differences({"lines of product": 1000}, {"lines of product": 500}) == ([], ["lines of product: 1000 -> 500"])
    assert measure.differences({"lines of product": 1000}, {"lines of product": 1001}) == (["lines of product: 1000 -> 1001"], [])


def test_an_update_raises_nothing(tmp_path, monkeypatch: pytest.MonkeyPatch) -> None:  # type: ignore[no-untyped-def]
    written = measure.to_toml({"measures": {"tables by string": 1}})
    (tmp_path / "ratchet.toml").write_text(written)
    monkeypatch.setattr(measure, "RATCHET", tmp_path / "ratchet.toml")
    monkeypatch.setattr(measure, "current", lambda: {"measures": {"tables by string": 2}})
    assert measure.update({}) == ["measures: tables by string: 1 -> 2"]
    assert (tmp_path / "ratchet.toml").read_text() == written
    monkeypatch.setattr(measure, "current", lambda: {"measures": {"tables by string": 0}})
    assert measure.update({}) == []
    assert measure.ratchet() == {"measures": {"tables by string": 0}}


def test_names_are_found_as_words() -> None:
    pattern = measure.word("rating")
    assert [bool(pattern.search(text)) for text in ("rating", "end_rating_of", "operating", "ratings")] == [True, True, False, False]


def test_features_and_imports_between_them_are_found() -> None:
    assert measure.feature("app.study.visits") == "app.study"
    assert measure.feature("app.study.sessions.pages") == "app.study.sessions"
    assert ("app.cli", "app.main") in measure.imports()
    assert all(a.split(".")[1] == b.split(".")[1] for a, b in measure.between_features())
