"""What pages show alike: numbers without a stray sign, one set of colours on page and paper."""

from __future__ import annotations

import re
from pathlib import Path

from app.analysis.biomarker.charts import SCALE
from app.analysis.figures import COLOURS
from app.platform.web.templates import fixed

STATIC = Path(__file__).parents[4] / "static"


def test_what_rounds_to_nothing_has_no_sign() -> None:
    assert [fixed(v, 1) for v in (-0.02, 0.0, -0.06)] == ["0.0", "0.0", "\u22120.1"]


def test_figures_for_papers_have_the_colours_of_the_pages() -> None:
    tokens = dict(re.findall(r"--c-(\w+): light-dark\((#\w+),", (STATIC / "app.css").read_text()))
    assert {name: tokens[name] for name in COLOURS} == COLOURS


def test_visits_in_a_scatter_take_colours_of_the_theme() -> None:
    tokens = re.findall(r"--c-(\w+): light-dark", (STATIC / "app.css").read_text())
    assert all(colour.removeprefix("token:") in tokens for _, colour in SCALE)
