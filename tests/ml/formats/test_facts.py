"""The table of facts in docs/ingest/facts.md: one row per fact that the formats' packages have, word for word."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from ml.formats import DEVICES, DeviceFormat
from ml.formats.facts import Facts

DOCUMENT = Path(__file__).parents[3] / "docs/ingest/facts.md"


def rows(name: str, facts: Facts) -> list[str]:
    """Write each fact as a row: format, kind, where, what, source."""
    out = [f"| {name} | clock: {c.clock} | {c.fields} | {c.offset} | {c.source} |" for c in facts.clocks]
    for field, counter in facts.counters.items():
        kind = "restarts" if counter.always else "restarts in some files"
        out.append(f"| {name} | counter | {field} | {kind} at {counter.turn:,.0f} {counter.unit} | {counter.source} |")
    for field, bounds in facts.fields.items():
        listed = ", ".join(f"{s:,g}" if s != int(s) else f"{int(s):,}" for s in bounds.sentinels)
        what = f"{bounds.low:,g} to {bounds.high:,.10g} {bounds.unit}; no reading: {listed}"
        out.append(f"| {name} | field | {field} | {what} | {bounds.source} |")
    out += [f"| {name} | dose: {d.name} | {d.fields} | {d.effect} | {d.source} |" for d in facts.dose]
    return out


@pytest.mark.parametrize("one", DEVICES, ids=lambda one: one.kind)
def test_the_document_has_every_fact_of_a_format_and_no_other(one: DeviceFormat) -> None:
    name = one.device
    written = [
        line
        for line in DOCUMENT.read_text().splitlines()
        if line.startswith((f"| {name} | clock", f"| {name} | counter", f"| {name} | field", f"| {name} | dose"))
    ]
    assert written == rows(name, one.code.facts)


if __name__ == "__main__":
    sys.stdout.write("".join(f"{row}\n" for one in DEVICES for row in rows(one.device, one.code.facts)))
