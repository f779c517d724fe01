"""Tables that a column mapping reads: a step's begin or end, lines that are no rows, nights in which clocks are changed."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ml.formats.options import DecodeOptions
from ml.formats.recording import UndecodableFile
from ml.formats.source import InMemory
from ml.formats.tables.cells.delimited import TextTable
from ml.formats.tables.mapping import MappedColumn, TableMapping, decode_mapped, preview_of, redact_mapped
from ml.formats.tables.mapping.model import header_hash
from ml.formats.tables.mapping.times import read_times

KEY = b"k" * 32
NAMES = ["when", "b", "i"]
COLUMNS = (MappedColumn(1, "time"), MappedColumn(2, "beta", "uV"), MappedColumn(3, "amplitude_ma", "mA"))
STEPS = TableMapping(header_hash(NAMES, KEY), 3, 0, "steps", "seconds", None, None, False, COLUMNS)
DATES = replace(STEPS, time_format="dmy", zone="Europe/Berlin")


def times(mapping: TableMapping, *cells: str) -> np.ndarray:
    table = TextTable(["column 1"], list(range(2, 2 + len(cells))), [[cell] for cell in cells], ";", [])
    return read_times(table, 0, mapping)


@pytest.mark.parametrize(("time_format", "begin", "scale"), [("seconds", 0, 1), ("unix_ms", 1_772_445_600_000, 1000)])
def test_the_begin_and_the_end_of_steps_put_every_amplitude_to_the_same_step(
    tmp_path: Path, time_format: str, begin: int, scale: int
) -> None:
    found = []
    for row_begins in (True, False):
        rows = "".join(f"{begin + scale * 2 * (k + (not row_begins))};{k + 1};{0.1 * k:.1f}\n" for k in range(12))
        mapping = replace(STEPS, time_format=time_format, row_begins=row_begins)  # type: ignore[arg-type]
        redact_mapped(InMemory((";".join(NAMES) + "\n" + rows).encode()), tmp_path / "t", mapping, KEY, DecodeOptions())
        (recording,) = decode_mapped(tmp_path / "t", DecodeOptions()).recordings
        found.append(recording)
    assert found[0].started_at == found[1].started_at
    for trace, same in zip(found[0].traces, found[1].traces, strict=True):
        assert trace.t_end_s[0] == same.t_end_s[0] == 2.0
        np.testing.assert_array_equal(trace.values, same.values)


def test_a_row_is_never_passed_over_as_a_line_of_units_or_of_names(tmp_path: Path) -> None:
    rows = [f"{2 * k};{k};0.5" for k in range(1, 12)]
    for mapping, lines, where in (
        (replace(STEPS, unit_lines=1), [";".join(NAMES), *rows], "line 2"),
        (replace(STEPS, header=header_hash(rows[0].split(";"), KEY)), [";".join(NAMES), *rows], "line 2"),
    ):
        with pytest.raises(UndecodableFile, match="holds measurements") as refused:
            redact_mapped(InMemory("\n".join(lines).encode()), tmp_path / "t", mapping, KEY, DecodeOptions())
        assert refused.value.where == where
    assert not (tmp_path / "t").exists()
    units = "\n".join([";".join(NAMES), "s;uV;mA", *rows]).encode()
    redact_mapped(InMemory(units), tmp_path / "t", replace(STEPS, unit_lines=1), KEY, DecodeOptions())
    (recording,) = decode_mapped(tmp_path / "t", DecodeOptions()).recordings
    assert recording.traces[0].values.size == 11


@pytest.mark.parametrize("cell", ["25.10.2026 02:30:00", "29.03.2026 02:30:00"])
def test_a_time_that_the_clocks_show_twice_or_never_is_refused_with_its_line(cell: str) -> None:
    with pytest.raises(UndecodableFile, match="twice or never") as refused:
        times(DATES, cell[:11] + "00:30:00", cell)
    assert refused.value.where == "line 3, column 1"
    assert cell not in refused.value.stored_what


def test_times_before_and_after_clocks_are_changed_and_those_with_an_offset_are_read() -> None:
    night = times(DATES, "25.10.2026 01:59:59", "25.10.2026 03:00:00")
    assert np.diff(night).tolist() == [7201], "the hour from 2 to 3 is there twice"
    iso = replace(DATES, time_format="iso")
    assert np.diff(times(iso, "2026-10-25 02:30:00+02:00", "2026-10-25 02:30:00+01:00")).tolist() == [3600]


def test_day_numbers_of_a_spreadsheet_and_names_of_months_are_moments_in_the_stated_zone() -> None:
    excel = replace(DATES, time_format="excel")
    assert times(excel, "46086,6319444444", "46086.6319675926") == pytest.approx(
        times(DATES, "05.03.2026 15:10:00", "05-Mar-2026 15:10:02")
    )
    with pytest.raises(UndecodableFile, match="is no date and time written like"):
        times(excel, "1772719800")


def test_whole_numbers_that_may_name_a_person_are_not_shown() -> None:
    rows = "".join(f"{2 * k};{700 + k};{8100 + k};{1950 + k % 2};4711;{k + 0.5}\n" for k in range(1, 9))
    shown = preview_of(InMemory(("time;left counts;FallNr;geb;sample;x7\n" + rows).encode()), KEY)
    assert shown is not None
    assert shown["lines"][1]["cells"] == ["2", "701", "####", "####", "####", "1.5"]
