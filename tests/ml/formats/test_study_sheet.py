"""Sheets of a whole study, as groups write them: their columns, dates, zones and codes."""

from __future__ import annotations

import io
import zipfile
from datetime import UTC, date, datetime
from zoneinfo import ZoneInfo

import pytest

from ml.formats import UndecodableFile
from ml.formats.studies.sheet import read_sheet, write_sheet

BERLIN = ZoneInfo("Europe/Berlin")


def workbook(rows: list[list[str | float]]) -> bytes:
    """Write the least xlsx that has these cells: numbers as numbers, text inline."""

    def cell(value: str | float, place: str) -> str:
        if isinstance(value, str):
            return f'<c r="{place}" t="inlineStr"><is><t>{value}</t></is></c>'
        return f'<c r="{place}"><v>{value}</v></c>'

    lines = "".join(
        f'<row r="{i}">{"".join(cell(v, f"{chr(65 + k)}{i}") for k, v in enumerate(row))}</row>' for i, row in enumerate(rows, start=1)
    )
    main, doc = "http://schemas.openxmlformats.org/spreadsheetml/2006/main", "http://schemas.openxmlformats.org/officeDocument/2006"
    package = "http://schemas.openxmlformats.org/package/2006"
    kinds = "application/vnd.openxmlformats-officedocument.spreadsheetml"
    parts = {
        "[Content_Types].xml": f'<Types xmlns="{package}/content-types"><Default Extension="rels" '
        'ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
        f'<Override PartName="/xl/workbook.xml" ContentType="{kinds}.sheet.main+xml"/>'
        f'<Override PartName="/xl/worksheets/sheet1.xml" ContentType="{kinds}.worksheet+xml"/></Types>',
        "_rels/.rels": f'<Relationships xmlns="{package}/relationships"><Relationship Id="r1" Type="{doc}/relationships/officeDocument" '
        'Target="xl/workbook.xml"/></Relationships>',
        "xl/workbook.xml": f'<workbook xmlns="{main}" xmlns:r="{doc}/relationships"><sheets><sheet name="s" sheetId="1" r:id="r1"/>'
        "</sheets></workbook>",
        "xl/_rels/workbook.xml.rels": f'<Relationships xmlns="{package}/relationships"><Relationship Id="r1" '
        f'Type="{doc}/relationships/worksheet" Target="worksheets/sheet1.xml"/></Relationships>',
        "xl/worksheets/sheet1.xml": f'<worksheet xmlns="{main}"><sheetData>{lines}</sheetData></worksheet>',
    }
    out = io.BytesIO()
    with zipfile.ZipFile(out, "w") as archive:
        for name, text in parts.items():
            archive.writestr(name, f'<?xml version="1.0" encoding="UTF-8"?>{text}')
    return out.getvalue()


def test_a_sheet_is_read_with_its_zone() -> None:
    text = "Subject;Visit;Date;Start;Condition;Grasp frequency;Rating;Notes\nP1;2;2026-03-05;10:05;Continuous DBS;2,4;8;fine\n"
    (row,) = read_sheet(text.encode(), BERLIN).rows
    assert (row.participant, row.visit, row.controller, row.day) == ("P1", 2, "cdbs", date(2026, 3, 5))
    assert row.start == datetime(2026, 3, 5, 9, 5, tzinfo=UTC)
    assert row.outcomes == {"grasp_hz": 2.4, "rating": 8.0}
    assert row.has_note


def test_a_workbook_is_read_as_a_text_is() -> None:
    cells: list[list[str | float]] = [
        ["participant", "visit", "controller", "start", "rating"],
        ["P1", 1.0, "random", "2026-03-05T10:00Z", 7.0],
    ]
    (row,) = read_sheet(workbook(cells)).rows
    assert (row.visit, row.controller, row.outcomes) == (1, "random", {"rating": 7.0})
    assert row.start == datetime(2026, 3, 5, 10, tzinfo=UTC)


@pytest.mark.parametrize(
    ("row", "why"),
    [
        ("P1,1,cdbs,2026-03-05 10:05", "has no zone"),
        ("P1,1,xyz,2026-03-05T10:05Z", "controller 'xyz' is none of"),
        ("P1,0,cdbs,2026-03-05T10:05Z", "no number of a visit"),
        ("P1,1,cdbs,05/03/2026 10:05", "is no date and time"),
        (",1,cdbs,2026-03-05T10:05Z", "no participant"),
        ("P1,1,cdbs,10:05", "has no date"),
    ],
)
def test_a_row_that_cannot_be_used_says_why_and_harms_no_other(row: str, why: str) -> None:
    sheet = read_sheet(f"participant,visit,controller,start\n{row}\nP2,1,cdbs,2026-03-05T10:05Z\n".encode())
    assert [r.participant for r in sheet.rows] == ["P2"]
    ((line, said),) = sheet.problems
    assert line == 2
    assert why in said


def test_a_time_of_the_night_in_which_clocks_change_is_not_guessed() -> None:
    sheet = read_sheet(b"participant,visit,controller,start\nP1,1,cdbs,2026-10-25 02:30\n", BERLIN)
    assert "twice or never" in sheet.problems[0][1]


def test_a_redcap_export_is_read_by_its_dictionary() -> None:
    dictionary = (
        b'"Variable / Field Name","Form Name","Field Type","Field Label","Choices, Calculations, OR Slider Labels"\n'
        b'record_id,base,text,Participant,\nses_t0,session,text,Session start,\narm,session,radio,Controller,"1, cDBS | 2, No DBS"\n'
        b"gr,session,text,Grasp frequency (Hz),\n"
    )
    export = b"record_id,redcap_event_name,ses_t0,arm,gr\nP7,visit_3_arm_1,2026-03-05 10:05,2,1.9\n"
    (row,) = read_sheet(export, BERLIN, dictionary).rows
    assert (row.participant, row.visit, row.controller, row.outcomes) == ("P7", 3, "no_dbs", {"grasp_hz": 1.9})


def test_stated_columns_come_before_names() -> None:
    text = b"participant,visit,controller,begin of test,start\nP1,1,cdbs,2026-03-05T10:00Z,x\n"
    (row,) = read_sheet(text, columns={"start": "begin of test"}).rows
    assert row.start == datetime(2026, 3, 5, 10, tzinfo=UTC)
    with pytest.raises(UndecodableFile, match="no column 'nothing'"):
        read_sheet(text, columns={"start": "nothing"})


def test_a_sheet_without_a_controller_is_refused() -> None:
    with pytest.raises(UndecodableFile, match="no column controller"):
        read_sheet(b"participant,visit\nP1,1\n")


def test_what_is_written_is_read() -> None:
    rows = [
        {"participant": "P1", "visit": 2, "controller": "random", "start": "2026-03-05T10:00:00+00:00", "minutes": 2.5, "rating": 7,
         "lower_bound": 0.3, "design": "stratified", "design_parameters": {"level": 0.5, "holds": []}, "policy": None},
    ]  # fmt: skip
    (row,) = read_sheet(write_sheet(rows).encode()).rows
    assert (row.minutes, row.policy) == (2.5, None)
    assert row.design == {"lower_bound": 0.3, "design": "stratified", "design_parameters": {"level": 0.5, "holds": []}}
    assert row.outcomes == {"rating": 7.0}
