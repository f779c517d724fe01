"""What pages show alike: numbers without a stray sign, one set of colours on page and paper."""

from __future__ import annotations

import re
from pathlib import Path

from app.analysis.biomarker.charts import SCALE
from app.analysis.figures import COLOURS
from app.platform.web.charts import figure, written
from app.platform.web.templates import fixed, number, place, rate, stated, typed, whole

ROOT = Path(__file__).parents[4]
STATIC = ROOT / "static"
OWN_FORMAT = re.compile(r"(?<!\{)%[-+0]*\d*(?:\.\d+)?[gfeGE]\b|\|\s*round\b")
"""A number that a template formats by itself: `"%.3g"|format(x)`, `x|round`."""

OWN_DIGITS = re.compile(r":[-+,z]*\.\d+[geE]\}")
TOLD_BY_MODULES = ("app/evaluation/ranking/picture.py",)
"""Modules whose tables and marks take numbers as pages do; others still write theirs."""


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
    for path in TOLD_BY_MODULES:
        found |= {
            f"{path}:{n}": hit for n, line in enumerate((ROOT / path).read_text().splitlines(), 1) if (hit := OWN_DIGITS.findall(line))
        }
    assert OWN_DIGITS.findall('f"{a:.3g} {b:,.2e}"') == [":.3g}", ":,.2e}"]
    assert found == {}, "use the filters number, fixed, stated, whole, typed or place"
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
