"""Cards of the printed sheet: one per session, with all that its operator needs, and blanks for observations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from fpdf import FPDF

from app.planning.plans.view import PlanView
from app.planning.sheet.content import Card, card_of
from app.planning.sheet.ink import INK, LINE, MUTED, latin
from ml.outcomes import OUTCOMES

WIDTH = 277.0
_GAP, _PAD = 5.0, 2.0
_CARD = (WIDTH - _GAP) / 2
_HEAD, _TEXT, _BLANKS = 6.4, 3.9, 10.5
_FIELDS = (
    ("Started hh:mm", 20.0), *((f"{o.short} {o.entry_unit}", 16.0) for o in OUTCOMES), ("Medication, notes, adverse effects", 0.0),
)  # fmt: skip


def draw_cards(pdf: FPDF, view: PlanView, bundles: Mapping[int, str], ports: Mapping[int, str]) -> None:
    """Draw all cards, two side by side in the order of the day; no card is cut by the end of a page."""
    cards = [card_of(line, view, bundles.get(line.item.id), ports) for line in view.lines]
    for pair in (cards[i : i + 2] for i in range(0, len(cards), 2)):
        height = max(_height(pdf, card) for card in pair)
        if pdf.will_page_break(height):
            pdf.add_page()
        top = pdf.get_y()
        for i, card in enumerate(pair):
            _draw(pdf, card, pdf.l_margin + i * (_CARD + _GAP), top, height)
        pdf.set_xy(pdf.l_margin, top + height + 2.5)


def _wrapped(pdf: FPDF, text: str, width: float) -> Sequence[str]:
    return list(pdf.multi_cell(width, _TEXT, latin(text), dry_run=True, output="LINES"))


def _set(pdf: FPDF, style: str, size: float, ink: tuple[int, int, int] = INK) -> None:
    pdf.set_font("Helvetica", style, size)
    pdf.set_text_color(*ink)


def _body(pdf: FPDF, card: Card) -> list[tuple[str, str, str]]:
    """Break the lines of a card to fit its width: style, label, text."""
    found = []
    for label, text in card.lines:
        style = "B" if label in ("Policy", "Limits") else ""
        _set(pdf, style, 8.5)
        found += [(style, label if i == 0 else "", part) for i, part in enumerate(_wrapped(pdf, text, _CARD - 2 * _PAD - 19))]
    for text in card.warnings:
        _set(pdf, "B", 8)
        found += [("!", "!" if i == 0 else "", part) for i, part in enumerate(_wrapped(pdf, text, _CARD - 2 * _PAD - 4))]
    return found


def _height(pdf: FPDF, card: Card) -> float:
    return _HEAD + 2 * 1.2 + _TEXT * len(_body(pdf, card)) + _BLANKS


def _draw(pdf: FPDF, card: Card, x: float, top: float, height: float) -> None:
    pdf.set_draw_color(*LINE)
    pdf.set_fill_color(*card.fill)
    pdf.rect(x, top, _CARD, _HEAD, style="DF")
    pdf.rect(x, top, _CARD, height)
    _set(pdf, "B", 10)
    pdf.set_xy(x + _PAD, top)
    pdf.cell(_CARD - 2 * _PAD, _HEAD, latin(card.head))
    _set(pdf, "", 8.5)
    pdf.set_xy(x + _PAD, top)
    pdf.cell(_CARD - 2 * _PAD, _HEAD, latin(card.minutes), align="R")
    y = top + _HEAD + 1.2
    for style, label, text in _body(pdf, card):
        indent = 4.0 if style == "!" else 19.0
        _set(pdf, "B" if style == "!" else "", 8, INK if style == "!" else MUTED)
        pdf.set_xy(x + _PAD, y)
        pdf.cell(indent, _TEXT, latin(label))
        _set(pdf, "B" if style else "", 8 if style == "!" else 8.5)
        pdf.cell(_CARD - 2 * _PAD - indent, _TEXT, text)
        y += _TEXT
    _blanks(pdf, x, top + height - _BLANKS)


def _blanks(pdf: FPDF, x: float, top: float) -> None:
    """Draw boxes to fill in by hand, each with its name in small letters."""
    _set(pdf, "", 6.5, MUTED)
    pdf.line(x, top, x + _CARD, top)
    left = x
    for name, width in _FIELDS:
        pdf.text(left + 1, top + 2.7, name)
        left += width
        if width:
            pdf.line(left, top, left, top + _BLANKS)
