"""Cards of the printed sheet: one per session, with all that whoever runs it needs, and blanks for what is seen."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from fpdf import FPDF

from app.planning import wording
from app.planning.plans.view import PlanLine, PlanView
from app.planning.sheet.ink import INK, LINE, MUTED, clock, printed_name, printed_warning, shade
from app.planning.sheet.latin1_text import latin

WIDTH = 277.0
_GAP, _PAD = 5.0, 2.0
_CARD = (WIDTH - _GAP) / 2
_HEAD, _TEXT, _BLANKS = 6.4, 3.9, 10.5
_FIELDS = (
    ("Started hh:mm", 20.0), ("Grasp Hz", 15.0), ("Rating 1-10", 17.0), ("Tremor %", 15.0), ("Medication, notes, adverse effects", 0.0),
)  # fmt: skip
HASH = 12
"""Characters of a hash that are printed: enough to tell two bundles of a study apart by eye."""


@dataclass(frozen=True)
class Card:
    """What stands on a card.

    Attributes:
        head, minutes: of its title line, left and right. lines: label and text. warnings: a sentence each. fill: colour of the title line.
    """

    head: str
    minutes: str
    lines: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...]
    fill: tuple[int, int, int]


def card_of(line: PlanLine, view: PlanView, bundle: str | None) -> Card:
    """A session's card; of a sealed plan's session, which has lost its controller, letters and common limits alone."""
    item = line.item
    length = f"{item.minutes:g} min"
    for minutes, what in ((item.washout_minutes, "washout"), (item.break_minutes, "break")):
        length += f", then {minutes:g} min {what}" if minutes else ""
    limits = f"{wording.limits_ma(item)} mA" if item.max_ma is not None else "not set"
    limits += f", ramp {item.ramp_ma_per_s:g} mA/s" if item.ramp_ma_per_s is not None else ""
    limits += f", {item.hemisphere} side" if item.hemisphere else ""
    told = {
        "Policy": printed_name(line.policy) if line.policy else "",
        "Limits": limits,
        "Design": wording.design_name(line.design) if line.design else "",
        "Bundle": "" if view.sealed else bundle[:HASH] if bundle else "not taken yet",
        "Predicted": _predicted(line),
        "Medication": f"due before: {item.medication}" if item.medication else "",
    }
    mine = [w for w in view.warnings if line.policy is not None and w.policy_id == line.policy.id]
    warnings = tuple(printed_warning(wording.warning(w), line.policy) for w in mine)
    head = f"{item.position}  {clock(line.start_minute, view.plan.starts_at)}  {wording.session_name(item)}"
    return Card(head, length, tuple((label, text) for label, text in told.items() if text), warnings, shade(line))


def draw_cards(pdf: FPDF, view: PlanView, bundles: Mapping[int, str]) -> None:
    """All cards, two beside each other in the order of the day; no card is cut by the end of a page."""
    cards = [card_of(line, view, bundles.get(line.item.id)) for line in view.lines]
    for pair in (cards[i : i + 2] for i in range(0, len(cards), 2)):
        height = max(_height(pdf, card) for card in pair)
        if pdf.will_page_break(height):
            pdf.add_page()
        top = pdf.get_y()
        for i, card in enumerate(pair):
            _draw(pdf, card, pdf.l_margin + i * (_CARD + _GAP), top, height)
        pdf.set_xy(pdf.l_margin, top + height + 2.5)


def _predicted(line: PlanLine) -> str:
    """What is predicted of a session; empty of one that was not ranked, as cDBS, whose energy is 1 by definition."""
    e = line.estimate
    if e is None:
        return ""
    told = [] if line.predicted_energy is None else [f"energy {line.predicted_energy:.2f} of cDBS"]
    units = (("grasp_hz", "grasp {:.2f} Hz"), ("rating", "rating {:.1f}"), ("tremor_percent", "tremor {:.0f} %"))
    told += [words.format(e.predicted[name]) for name, words in units if name in e.predicted]
    return ", ".join([*told, f"return {e.value:.4g} ({e.low:.4g} to {e.high:.4g})" + ("" if e.supported else " *")])


def _wrapped(pdf: FPDF, text: str, width: float) -> Sequence[str]:
    return list(pdf.multi_cell(width, _TEXT, latin(text), dry_run=True, output="LINES"))


def _set(pdf: FPDF, style: str, size: float, ink: tuple[int, int, int] = INK) -> None:
    pdf.set_font("Helvetica", style, size)
    pdf.set_text_color(*ink)


def _body(pdf: FPDF, card: Card) -> list[tuple[str, str, str]]:
    """Lines of a card as they fit its width: style, label, text."""
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
    """Boxes to fill in by hand, each with its name in small letters."""
    _set(pdf, "", 6.5, MUTED)
    pdf.line(x, top, x + _CARD, top)
    left = x
    for name, width in _FIELDS:
        pdf.text(left + 1, top + 2.7, name)
        left += width
        if width:
            pdf.line(left, top, left, top + _BLANKS)
