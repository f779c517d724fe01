"""Amplitudes in mA: no rounding prints one beyond the limit that it keeps, at any place that prints mA."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from app.platform.numbers import ma

ROOT = Path(__file__).resolve().parents[3]
COARSE = re.compile(
    # f-strings and calls of Python, filters of templates, and the macro that shows a number with its unit
    r""":\.(?:[01]f|[1-3]g)\}(?: to \{[^{}]*\})?[ \w]{0,3}\bmA\b"""
    r"""|\b(?:number|fixed|stated)\([^()]*(?:\([^()]*\))?[^()]*\)\}\s*mA\b"""
    r"""|\|(?:number(?:\(\d\))?|fixed(?:\([01]?\))?|stated\([1-3]\))\s*\}\}\s*mA\b"""
    r"""|\|(?:number(?:\(\d\))?|fixed(?:\([01]?\))?|stated\([1-3]\)),\s*["]mA["]"""
    r"""|%s(?: to %s)? mA[^"]*"\|format\([^()]*\|(?:number\b|fixed\([01]?\)|stated\([1-3]\))"""
)
"""Formats that leave less than hundredths of an amplitude."""
BOUNDS_OF_ERRORS = {"app/templates/planning/bundle.html": 1, "ml/deploy/sheet.py": 1, "ml/deploy/runtime/__main__.py": 2}
"""By file: places that print how far an answer may be off, which is no amplitude."""


def coarse(text: str) -> list[str]:
    return [match[0] for match in COARSE.finditer(text)]


@pytest.mark.parametrize(
    "line",
    [
        'f"held near {f.value:.1f} mA"',
        'f"{low:.2g} to {high:.3g} mA"',
        "{{ answer.cdbs_ma|fixed(1) }} mA",
        "{{ manifest.min_ma|number }} mA",
        '{{ stat("cDBS", cdbs|stated(3), "mA") }}',
        '"%s mA: there the limit decides"|format(manifest.min_ma|number)',
        'f"constant at {stated(high, 3)} mA"',
    ],
)
def test_coarse_formats_are_found(line: str) -> None:
    assert coarse(line)


def test_no_place_prints_an_amplitude_coarser_than_hundredths() -> None:
    files = [p for root in ("app", "ml") for p in (ROOT / root).rglob("*") if p.suffix in (".py", ".html")]
    texts = {str(p.relative_to(ROOT)): p.read_text() for p in files}
    assert sum("mA" in text for text in texts.values()) > 40
    found = {path: hits for path, text in texts.items() if (hits := coarse(text))}
    assert {path: hits for path, hits in found.items() if len(hits) > BOUNDS_OF_ERRORS.get(path, 0)} == {}


def test_a_printed_amplitude_keeps_the_printed_limit_that_it_keeps() -> None:
    assert [ma(v) for v in (2.55, 12.75, 2.5, 3.0, 0.1 + 0.2, 2.555, None)] == ["2.55", "12.75", "2.5", "3", "0.3", "2.555", "\u2014"]
    rng = np.random.default_rng(0)
    for limit in np.round(rng.uniform(0.05, 25.5, 2000), 2).tolist():
        below, above = limit * (1 - rng.random() * 1e-2), limit * (1 + rng.random() * 1e-2)
        assert float(ma(below)) <= float(ma(limit)) == limit <= float(ma(above))
