"""Tables of answers: what is wrong with one is named by line, with what to do."""

from __future__ import annotations

import numpy as np
import pytest

from ml.deploy.ports.answers import Answers, AnswersError, read_answers, write_answers
from ml.deploy.ports.vectors import to_csv


@pytest.fixture(scope="module")
def rows(port):
    return write_answers(port.vectors, Answers(port.answers(), None)).decode().splitlines()


def refuse(port, lines):
    with pytest.raises(AnswersError) as caught:
        read_answers("\n".join(lines).encode(), port.vectors)
    return str(caught.value), caught.value.hint


def change(rows, line, text):
    return [*rows[: line - 1], text, *rows[line:]]


def test_a_table_reads_back_as_it_was_written(port):
    decided = port.vectors.decision_ma
    read = read_answers(write_answers(port.vectors, Answers(port.answers(), decided)), port.vectors)
    np.testing.assert_array_equal(read.fraction, port.answers())
    np.testing.assert_array_equal(read.decided_ma, decided)


def test_a_column_may_be_added_to_the_vectors_and_spreadsheets_may_have_saved_it(port):
    header, *lines = to_csv(port.vectors).decode().splitlines()
    added = [header + ",answer", *(f"{line},{i / 1000}" for i, line in enumerate(lines))]
    read = read_answers(b"\xef\xbb\xbf" + "\r\n".join(added).encode() + b"\r\n\r\n", port.vectors)
    np.testing.assert_allclose(read.fraction, np.arange(400) / 1000)


def test_missing_numbers_are_no_answer(port, rows):
    head = rows[1].rsplit(",", 1)[0]
    for text in ("", "nan", "NaN", "null", "NA"):
        assert np.isnan(read_answers("\n".join(change(rows, 2, f"{head},{text}")).encode(), port.vectors).fraction[0])


def test_a_cut_file(port, rows):
    said, hint = refuse(port, rows[:313])
    assert said == "line 313: the file ends here, after 312 of 400 rows"
    assert "was cut" in hint
    said, hint = refuse(port, [*rows[:312], rows[312][:6]])
    assert said.startswith("line 313: ")
    assert "cut" in hint
    assert refuse(port, rows[:1])[0] == "line 1: the file ends here, after 0 of 400 rows"
    assert refuse(port, [])[0] == "line 1: the header needs one column 'row'"


def test_other_hashes(port, rows):
    number, _, answer = rows[41].split(",")
    said, hint = refuse(port, change(rows, 42, f"{number},0123456789ab,{answer}"))
    assert said == f"line 42: hash '0123456789ab' is not that of row 41 of this bundle, {port.vectors.hashes[40]}"
    assert "vectors of this bundle" in hint


def test_rows_in_another_order(port, rows):
    said, hint = refuse(port, [*rows[:10], rows[11], rows[10], *rows[12:]])
    assert said == "line 11: row 11 is where row 10 is due"
    assert "order of port-vectors.csv" in hint
    assert refuse(port, [*rows, rows[-1]])[0].startswith("line 402: there are more rows than the 400")


def test_text_in_the_column_of_doses(port, rows):
    head = rows[6].rsplit(",", 1)[0]
    said, hint = refuse(port, change(rows, 7, f"{head},full"))
    assert said == "line 7: 'full' in 'answer' is no number"
    assert "leave it empty" in hint


def test_decimal_commas(port, rows):
    head = rows[8].rsplit(",", 1)[0]
    said, hint = refuse(port, change(rows, 9, f"{head},0,5"))
    assert said == "line 9: 4 values where the header has 3"
    assert "decimal comma" in hint
    said, hint = refuse(port, change(rows, 9, f'{head},"0,5"'))
    assert said == "line 9: '0,5' in 'answer' has a decimal comma"
    assert hint == "Write it with a point, as 0.5."


def test_semicolons_spreadsheets_and_headers_without_the_columns(port, rows):
    assert refuse(port, [line.replace(",", ";") for line in rows])[0] == "line 1: the columns are not separated by commas"
    assert refuse(port, ["row,hash,dose", *rows[1:]])[0] == "line 1: the header names no column of answers"
    assert refuse(port, ["row,answer", *rows[1:]])[0] == "line 1: the header needs one column 'hash'"
    with pytest.raises(AnswersError, match="line 1: it is no text in UTF-8"):
        read_answers(b"PK\x03\x04\xff\xfe", port.vectors)
