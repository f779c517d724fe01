"""Shared look of pages: numbers without a stray sign, one set of colours on page and paper."""

from __future__ import annotations

import re
from pathlib import Path

from app.analysis.biomarker_web import SCALE
from app.analysis.figures import COLOURS
from app.platform.numbers import fixed, hover, number, place, rate, stated, typed, whole
from app.platform.web.charts import figure, written

ROOT = Path(__file__).parents[4]
STATIC = ROOT / "static"
OWN_FORMAT = re.compile(r"(?<!\{)%[-+0]*\d*(?:\.\d+)?[gfeGE]\b|\|\s*round\b")
"""A number that a template formats by itself: `"%.3g"|format(x)`, `x|round`."""

OWN_DIGITS = re.compile(r":[-+,z]*\.\d+[geE]\}")
OWN_PLACES = ("app/platform/numbers.py", "app/tablet/", "app/analysis/calibration_web.py")
"""Places of a format of digits: the one place of the pages, the tablet's wire and terminal, and a file of data."""
ROUNDED = 'float(f"'
"""How a line begins to round numbers that stay numbers."""


def test_what_rounds_to_nothing_has_no_sign() -> None:
    assert [fixed(v, 1) for v in (-0.02, 0.0, -0.06)] == ["0.0", "0.0", "\u22120.1"]


def test_a_negative_number_has_a_minus_sign_whatever_its_size() -> None:
    assert [number(v) for v in (-1234, -12.3, -0.05)] == ["\u22121\u202f234", "\u221212.3", "\u22120.0500"]


def test_numbers_are_formatted_in_one_place() -> None:
    found = {
        f"{path.relative_to(ROOT)}:{n}": hit
        for path in (ROOT / "app/templates").rglob("*.html")
        for n, line in enumerate(path.read_text().splitlines(), 1)
        if (hit := OWN_FORMAT.findall(line))
    }
    for path in (p for p in ROOT.glob("app/**/*.py") if not p.relative_to(ROOT).as_posix().startswith(OWN_PLACES)):
        found |= {
            f"{path.relative_to(ROOT)}:{n}": hit
            for n, line in enumerate(path.read_text().splitlines(), 1)
            if ROUNDED not in line and (hit := OWN_DIGITS.findall(line))
        }
    assert OWN_DIGITS.findall('f"{a:.3g} {b:,.2e}"') == [":.3g}", ":,.2e}"]
    assert found == {}, "use number, fixed, stated, whole, typed, place or hover of app.platform.numbers"
    assert OWN_FORMAT.findall('{{ "%g"|format(x) }} {{ "%.3g mA"|format(x) }} {{ x|round|int }} {% for %} {{ "%d"|format(3) }} 4 %') == [
        "%g", "%.3g", "|round",
    ]  # fmt: skip


def test_a_stated_number_has_the_digits_that_it_needs() -> None:
    assert [stated(v) for v in (2.5, 20.0, 0.125, 4 / 3, -1.5, -0.0, None, float("nan"))] == [
        "2.5", "20", "0.125", "1.33333", "\u22121.5", "0", "\u2014", "\u2014",
    ]  # fmt: skip
    assert [typed(v) for v in (2.5, 1.23456, -1.0, None)] == ["2.5", "1.235", "-1", ""], "a field takes what a keyboard types"
    assert (whole(19.6), place(1 / 3), rate(3e-4), number(2.5)) == (20, "0.33", "3e-4", "2.50")


def test_figures_for_papers_have_the_colours_of_the_pages() -> None:
    tokens = dict(re.findall(r"--c-(\w+): light-dark\((#\w+),", (STATIC / "app.css").read_text()))
    assert {name: tokens[name] for name in COLOURS} == COLOURS


def test_visits_in_a_scatter_take_colours_of_the_theme() -> None:
    tokens = re.findall(r"--c-(\w+): light-dark", (STATIC / "app.css").read_text())
    assert all(colour.removeprefix("token:") in tokens for _, colour in SCALE)


def test_units_are_written_as_people_write_them() -> None:
    given = ("uV over 2 s", "uV2/Hz \u00b7 n = 3", "60 us, 130 Hz", "(uA)", "plus 2", "Neu")
    assert [written(t) for t in given] == [
        "\u00b5V over 2 s",
        "\u00b5V\u00b2/Hz \u00b7 n = 3",
        "60 \u00b5s, 130 Hz",
        "(\u00b5A)",
        "plus 2",
        "Neu",
    ]


def test_figures_hold_as_many_digits_as_a_trace_and_their_units_in_writing() -> None:
    made = figure([{"y": [1 / 3, float("nan"), 2]}], yaxis={"title": "beta (uV2)"})
    assert made["data"][0]["y"] == [0.3333333, None, 2]
    assert made["layout"]["yaxis"]["title"] == "beta (\u00b5V\u00b2)"


def test_a_number_of_few_digits_shows_no_exponent_and_keeps_its_size() -> None:
    assert [stated(v, 3) for v in (2.5, 0.3333333, 1234.5, 12345678.0)] == ["2.5", "0.333", "1\u202f234", "12\u202f345\u202f678"]
    assert [typed(2.4790827393, 10), typed(2.4790827393)] == ["2.479082739", "2.479"]


def test_the_hover_text_of_a_chart_writes_digits_without_an_exponent() -> None:
    assert [hover(), hover("x"), hover("customdata", 4)] == ["%{y:,.3~r}", "%{x:,.3~r}", "%{customdata:,.4~r}"]


def test_a_number_too_small_for_six_decimals_is_neither_a_row_of_noughts_nor_a_signed_nought() -> None:
    assert [number(v) for v in (-1e-17, 1e-17, 0.0, -0.0)] == ["0"] * 4, "what rounding left"
    assert [number(v) for v in (1.234e-7, -4e-10)] == ["1.23\u00d710\u207b\u2077", "\u22124\u00d710\u207b\u00b9\u2070"]
    shown = [number(sign * 10.0**power) for sign in (1, -1) for power in range(-20, 7)]
    assert not [text for text in shown if set(text) <= set("\u22120.") and text != "0"]
