"""Records of device formats: each has all that the service asks of a format."""

from __future__ import annotations

from pathlib import Path
from typing import get_args

import pytest

from ml.formats import BY_KIND, DEVICES, TABLES, DeviceFormat, TraceSource, decode, redact, sniff


@pytest.mark.parametrize("one", DEVICES, ids=lambda one: one.kind)
def test_a_record_has_words_facts_and_sources_of_its_own(one: DeviceFormat) -> None:
    assert set(one.sources) <= set(get_args(TraceSource))
    assert one.device in one.upload
    assert one.device in one.file
    facts = one.code.facts
    assert all((facts.clocks, facts.fields, facts.dose))


def test_no_two_records_share_a_kind_or_a_source_and_one_reports_on_zips_that_cannot_be_read() -> None:
    assert len(BY_KIND) == len(DEVICES)
    assert not BY_KIND.keys() & TABLES
    sources = [source for one in DEVICES for source in one.sources]
    assert len(sources) == len(set(sources))
    assert sum(one.zipped for one in DEVICES) == 1


@pytest.mark.parametrize("one", [one for one in DEVICES if one.code.example], ids=lambda one: one.kind)
def test_the_example_of_a_format_is_known_cleaned_and_decoded(one: DeviceFormat, tmp_path: Path) -> None:
    assert one.code.example is not None
    one.code.example(tmp_path / "example")
    assert sniff(tmp_path / "example") == one.kind
    redact(tmp_path / "example", tmp_path / "clean", one.kind, bytes(32))
    assert [r.kind for r in decode(tmp_path / "clean").recordings] == [one.kind]


def test_a_kind_that_is_none_is_refused(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="mapped"):
        redact(tmp_path / "t.csv", tmp_path / "clean", "mapped", bytes(32))
