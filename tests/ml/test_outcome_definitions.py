"""Outcomes that a file defines: what is read from it, and a refusal in words for what cannot be."""

from __future__ import annotations

from pathlib import Path

import pytest

from ml.outcomes import BUILT_IN
from ml.outcomes.definitions import READY, DefinitionError, read_definitions

WHOLE = "key: gait, label: Gait, unit: m/s, low: 0, high: 3, better: higher, margin: {share: 0.1}"


def read(tmp_path: Path, text: str):  # type: ignore[no-untyped-def]
    file = tmp_path / "outcomes.yaml"
    file.write_text(text)
    return read_definitions(file, BUILT_IN)


def test_a_whole_definition_says_all_that_a_record_needs(tmp_path: Path) -> None:
    (gait,), judged = read(tmp_path, f"outcomes:\n  - {{{WHOLE}, usual: [0.2, 2], decimals: 2, failure: 0}}\njudged: [gait, rating]\n")
    assert judged == {"gait", "rating"}
    assert (gait.field, gait.low, gait.high, gait.usual, gait.decimals, gait.failure) == ("gait", 0, 3, (0.2, 2), 2, 0)
    assert (gait.higher_is_better, gait.resolution, gait.bounded, gait.prediction, gait.end) == (True, 0, False, None, None)
    assert gait.slack(2.7, 3.0, gait.margin.default) == pytest.approx(0)
    gait.check(3)
    with pytest.raises(ValueError, match="from 0 to 3"):
        gait.check(3.1)


@pytest.mark.parametrize("name", READY)
def test_a_ready_definition_needs_its_margin_alone(tmp_path: Path, name: str) -> None:
    ((made,), judged) = read(tmp_path, f"outcomes:\n  - {{use: {name}, margin: {{points: 1}}}}\n")
    assert judged is None
    assert (made.key, made.margin.default, made.margin.field) == (name, 1, f"{name}_margin")
    assert made.loss(1.0) == (-1.0 if made.higher_is_better else 1.0)
    with pytest.raises(DefinitionError, match=r"outcome 1: 'margin' is missing; write how much worse"):
        read(tmp_path, f"outcomes:\n  - {{use: {name}}}\n")


@pytest.mark.parametrize(
    ("text", "what"),
    [
        ("outcomes: [", "is no YAML"),
        ("rating: 1", "needs a list, `outcomes:`"),
        ("outcomes: {}", "`outcomes` must be a list"),
        ("outcomes: [grasp]", "an entry is a list of names and values, not 'grasp'"),
        ("outcomes: [{use: updrs, margin: {points: 1}}]", "there is no ready definition 'updrs'; there are mds_updrs_iii"),
        (f"outcomes: [{{{WHOLE}, colour: red}}]", "'colour' is not known here; known are better, decimals"),
        (f"outcomes: [{{{WHOLE.replace('key: gait, ', '')}}}]", "'key' is missing"),
        (f"outcomes: [{{{WHOLE.replace('gait', 'energy', 1)}}}]", "key 'energy' must be"),
        (f"outcomes: [{{{WHOLE.replace('gait', 'Gait speed', 1)}}}]", "key 'Gait speed' must be"),
        (f"outcomes: [{{{WHOLE.replace('higher', 'more')}}}]", "better must be 'higher' or 'lower', not 'more'"),
        (f"outcomes: [{{{WHOLE.replace('high: 3', 'high: 0')}}}]", "the range of gait must not be empty"),
        (f"outcomes: [{{{WHOLE.replace('high: 3', 'high: .inf')}}}]", "high must be a number, not inf"),
        (f"outcomes: [{{{WHOLE.replace('0.1', '1.5')}}}]", "gait_margin must be above 0, and below 1"),
        (f"outcomes: [{{{WHOLE.replace('share: 0.1', 'points: 3')}}}]", "a margin of 3 m/s must be above 0 and below the whole range of 3"),
        (f"outcomes: [{{{WHOLE.replace('{share: 0.1}', '0.1')}}}]", "margin must be one of points and share"),
        (f"outcomes: [{{{WHOLE}, usual: [2, 1]}}]", "usual must lie within 0 to 3, the lower end first"),
        (f"outcomes: [{{{WHOLE}, failure: 9}}]", "Gait must be from 0 to 3"),
        (f"outcomes: [{{{WHOLE}, whole: often}}]", "whole must be true or false, not 'often'"),
        (f"outcomes: [{{{WHOLE}, decimals: 9}}]", "decimals must be 0 to 4, not 9"),
        (f"outcomes: [{{{WHOLE}}}, {{{WHOLE}}}]", "outcome 2: another outcome has the name 'gait'; choose another"),
        (f"outcomes: [{{{WHOLE.replace('label: Gait', 'label: Rating')}}}]", "another outcome has the name 'rating'; choose another"),
        (f"outcomes: [{{{WHOLE}}}]\njudged: [gate]", "`judged` must be a list of some of grasp, rating, tremor, gait"),
    ],
)
def test_what_cannot_be_used_is_refused_with_its_place(tmp_path: Path, text: str, what: str) -> None:
    with pytest.raises(DefinitionError) as refused:
        read(tmp_path, text)
    assert what in str(refused.value)
    assert str(tmp_path / "outcomes.yaml") in str(refused.value)


def test_a_file_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(DefinitionError, match=r"none\.yaml, which BETALOOP_OUTCOMES names, cannot be read: No such file"):
        read_definitions(tmp_path / "none.yaml", BUILT_IN)
