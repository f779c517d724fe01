"""The visit plan on paper: A4 landscape, the built-in PDF fonts, readable in black and white.

What is planned stands on the left, blanks to fill in by hand on the right. A plan that is not approved says so across every page.
"""

from __future__ import annotations

from datetime import datetime

from fpdf import FPDF, FontFace
from fpdf.enums import XPos, YPos

from app.evaluation.wording import method_name
from app.learning.models import Policy
from app.planning import wording
from app.planning.plans.sign_off import SignatureState
from app.planning.plans.view import PlanLine, PlanView, shown
from app.planning.sheet.latin1_text import latin
from app.study.models import Controller

_WIDTH = 277.0
_COLUMNS = (
    ("#", 7), ("Start", 13), ("Controller", 25), ("Policy", 36), ("Limits\nmA", 20), ("Length\nmin", 14), ("Washout\nmin", 16),
    ("Estimated return\n(interval)", 40), ("Energy\ncDBS = 1", 18),
    ("Started\nhh:mm", 16), ("Grasp\nHz", 16), ("Rating\n1-10", 15), ("Tremor\n%", 15), ("Notes, adverse effects", 26),
)  # fmt: skip
_FIRST_BLANK = 9
_ROW_MM, _CLOSING_MM = 9.3, 35.0
_SHADES = {
    Controller.CDBS: (210, 228, 242),
    Controller.RL: (250, 221, 199),
    Controller.DISTILLED: (240, 214, 234),
    Controller.NO_DBS: (226, 229, 232),
    Controller.RANDOM: (207, 236, 226),
    Controller.OTHER: (240, 232, 200),
}
_INK, _MUTED, _LINE, _PLANNED = (20, 30, 38), (95, 108, 118), (150, 160, 168), (246, 248, 250)


class _Sheet(FPDF):  # type: ignore[misc]
    """Pages with the plan's name above, provenance and page number below, and DRAFT across where it is one."""

    def __init__(self, view: PlanView, printed_by: str, printed_at: datetime) -> None:
        super().__init__("landscape", "mm", "A4")
        self._view, self._printed = view, f"Printed {printed_at:%Y-%m-%d %H:%M} UTC by {printed_by}"
        self.set_margins(10, 9, 10)
        self.set_auto_page_break(True, 16)
        self.set_draw_color(*_LINE)
        self.set_line_width(0.2)
        self.c_margin = 0.0  # text begins where boxes begin
        self.set_creation_date(printed_at)
        self.set_title(latin(f"Visit plan {view.visit.participant.code}, visit {view.visit.number}"))
        self.set_creator("betaloop")

    def header(self) -> None:
        plan, visit = self._view.plan, self._view.visit
        self.set_text_color(*_INK)
        self.set_font("Helvetica", "B", 17)
        self.cell(0, 8, latin(f"Visit plan  {visit.participant.code}  visit {visit.number}"))
        self.set_xy(self.l_margin, self.t_margin)
        self.set_font("Helvetica", "", 11)
        day = visit.date.strftime("%A, %d %B %Y") if visit.date else "Date: ____________________"
        self.cell(0, 8, day, align="R", new_x=XPos.LMARGIN, new_y=YPos.NEXT)
        self.set_font("Helvetica", "", 9)
        self.set_text_color(*_MUTED)
        self.cell(0, 5, latin(f"Drafted by {plan.created_by}, {plan.created_at:%Y-%m-%d %H:%M} UTC.  {_approval(self._view)}."))
        self.ln(7)

    def footer(self) -> None:
        plan, evaluation = self._view.plan, self._view.evaluation
        ranking = f"evaluation {evaluation.id}, snapshot {evaluation.snapshot_id}" if evaluation else "no evaluation"
        self.set_y(-12)
        self.set_font("Helvetica", "", 8)
        self.set_text_color(*_MUTED)
        self.cell(0, 5, latin(f"betaloop \u00b7 plan {plan.id}, seed {plan.seed}, {ranking} \u00b7 {self._printed}"))
        self.set_x(self.l_margin)
        self.cell(0, 5, f"Page {self.page_no()} of {{nb}}", align="R")
        if plan.status != "approved":
            self._watermark(plan.status.upper())
        elif self._view.signature_state is SignatureState.BROKEN:
            self._watermark("DO NOT RUN")

    def _watermark(self, word: str) -> None:
        """Over everything, so that no filled cell hides it, and faint, so that it hides nothing."""
        self.set_font("Helvetica", "B", 120)
        self.set_text_color(*_INK)
        width = self.get_string_width(word)
        with self.local_context(fill_opacity=0.09), self.rotation(25, self.w / 2, self.h / 2):
            self.text((self.w - width) / 2, self.h / 2 + 14, word)


def _approval(view: PlanView) -> str:
    """Who signed, or why nothing here may be run."""
    plan = view.plan
    if plan.approved_at is None:
        return "NOT APPROVED: not for use with a participant"
    if view.signature_state is SignatureState.BROKEN:
        return "SIGNATURE BROKEN: changed after it was signed, not for use with a participant"
    by = f"Approved by {plan.approved_by}, {plan.approved_at:%Y-%m-%d %H:%M} UTC"
    return f"{by}, signature {view.signature.sha256[:12]}" if view.signature else by


def render(view: PlanView, printed_by: str, printed_at: datetime) -> bytes:
    """The sheet of a plan as PDF bytes.

    Args:
        view: the plan. printed_by: who printed it. printed_at: when; stands on the page and in the document's metadata.
    """
    view = shown(view)
    pdf = _Sheet(view, printed_by, printed_at)
    pdf.add_page()
    _timeline(pdf, view)
    _circumstances(pdf, view)
    if view.plan.note:
        _paragraph(pdf, "Note", view.plan.note)
    _table(pdf, view)
    _designs(pdf, view)
    _reading(pdf, view)
    _closing(pdf, view)
    return bytes(pdf.output())


def clock(minutes: float) -> str:
    """Minutes from the first session's start as h:mm."""
    whole = round(minutes)
    return f"{whole // 60}:{whole % 60:02d}"


def _timeline(pdf: _Sheet, view: PlanView) -> None:
    """The day to scale, washouts left white."""
    scale, top, height = _WIDTH / view.total_minutes, pdf.get_y(), 8.0
    pdf.set_text_color(*_INK)
    pdf.set_font("Helvetica", "", 8)
    for line in view.lines:
        x, width = pdf.l_margin + line.start_minute * scale, line.item.minutes * scale
        pdf.set_fill_color(*_shade(line))
        pdf.rect(x, top, width, height, style="DF")
        label = f"{line.item.position}  {wording.session_name(line.item)}"
        if pdf.get_string_width(label) > width - 2:
            label = str(line.item.position)
        pdf.set_xy(x, top)
        pdf.cell(width, height, label, align="C")
        if width > pdf.get_string_width(clock(line.start_minute)):
            pdf.text(x, top + height + 3.4, clock(line.start_minute))
    end = clock(view.total_minutes)
    last = view.lines[-1].item.minutes * scale
    if last > 2 * pdf.get_string_width(end) + 2:
        pdf.text(pdf.l_margin + _WIDTH - pdf.get_string_width(end), top + height + 3.4, end)
    pdf.set_xy(pdf.l_margin, top + height + 5.5)


def _circumstances(pdf: _Sheet, view: PlanView) -> None:
    """The stimulation that the day starts from, and blanks for what else bears on it."""
    stated = [
        f"{a.hemisphere} {a.amplitude_ma:g} mA" + (f" (program {a.program})" if a.program else "") for a in view.visit.cdbs_amplitudes
    ]
    shorthand = view.visit.participant.current_settings.cdbs_amplitude_ma
    amplitude = ", ".join(stated) or (f"{shorthand:g} mA" if shorthand else "__________ mA")
    pdf.set_text_color(*_INK)
    pdf.set_font("Helvetica", "", 9)
    blanks = f"Last medication, time and dose: {'_' * 38}    Stimulation site and program: {'_' * 30}"
    pdf.cell(0, 7, latin(f"cDBS amplitude: {amplitude}    {blanks}"), new_x=XPos.LMARGIN, new_y=YPos.NEXT)


def _table(pdf: _Sheet, view: PlanView) -> None:
    pdf.set_font("Helvetica", "", 9)
    pdf.set_text_color(*_INK)
    planned = FontFace(fill_color=_PLANNED)
    with pdf.table(
        width=_WIDTH, col_widths=[w for _, w in _COLUMNS], line_height=4, padding=(1, 1.2), text_align="LEFT", min_row_height=_ROW_MM,
        headings_style=FontFace(emphasis="BOLD", size_pt=8, fill_color=(232, 237, 241)), repeat_headings=1,
    ) as table:  # fmt: skip
        heading = table.row(min_height=9)
        for name, _ in _COLUMNS:
            heading.cell(name)
        for line in view.lines:
            row = table.row()
            for i, text in enumerate(_cells(line)):
                shade = FontFace(fill_color=_shade(line), emphasis="BOLD") if i == 2 else planned
                row.cell(latin(text), style=shade, align="RIGHT" if i in (0, 1, 4, 5, 6, 8) else "LEFT")
            for _ in _COLUMNS[_FIRST_BLANK:]:
                row.cell("", style=FontFace(fill_color=(255, 255, 255)))
    pdf.ln(2)


def _designs(pdf: _Sheet, view: PlanView) -> None:
    """What each random session tries and never does: it is signed with the plan."""
    for line in view.lines:
        if line.design is None:
            continue
        text = f"Session {line.item.position}: {wording.design_words(line.design)}"
        pdf.set_text_color(*_INK)
        if not line.design.holds:
            pdf.set_font("Helvetica", "", 8)
            pdf.multi_cell(_WIDTH, 3.8, latin(f"{text}."), align="L", new_x=XPos.LMARGIN, new_y=YPos.NEXT)
            continue
        pdf.set_font("Helvetica", "B", 8)
        text = f"{text}, seed {line.design.seed}; {wording.bound_words(line.design, line.design.bounds)}."
        pdf.multi_cell(_WIDTH, 3.8, latin(text), align="L", new_x=XPos.LMARGIN, new_y=YPos.NEXT)
        pdf.set_font("Helvetica", "", 8)
        unit = "mA" if line.design.bounds else "fraction of cDBS"
        words = f"min:s and {unit}:  {wording.schedule_words(line.design, line.design.bounds)}"
        pdf.multi_cell(_WIDTH, 3.8, latin(words), align="L", new_x=XPos.LMARGIN, new_y=YPos.NEXT)
        pdf.ln(1)
    pdf.ln(1)


def _cells(line: PlanLine) -> list[str]:
    """The planned part of a row, one text per column before the blanks."""
    item, e = line.item, line.estimate
    estimate = f"{e.value:.4g} ({e.low:.4g} to {e.high:.4g})" + ("" if e.supported else " *") if e else "-"
    energy = "-" if line.predicted_energy is None else f"{line.predicted_energy:.2f}"
    washout = f"{item.washout_minutes:g}" if item.washout_minutes else "-"
    policy = _breakable(_printed_name(line.policy)) if line.policy else "-"
    controller = wording.session_name(item)
    limits = wording.limits_ma(item)
    return [str(item.position), clock(line.start_minute), controller, policy, limits, f"{item.minutes:g}", washout, estimate, energy]


def _shade(line: PlanLine) -> tuple[int, int, int]:
    return _SHADES[Controller(line.item.controller)] if line.item.controller else _PLANNED


def _printed_name(policy: Policy) -> str:
    """A policy's name as the fonts can spell it, with its number where that is not the name itself: two policies never look alike."""
    printed = latin(policy.name)
    return printed if printed == policy.name else f"{printed} (#{policy.id})"


def _breakable(name: str, longest: int = 17) -> str:
    """A policy's name with a space in any stretch too long for its column."""
    words = [word[i : i + longest] for word in name.split(" ") for i in range(0, max(len(word), 1), longest)]
    return " ".join(words)


def _reading(pdf: _Sheet, view: PlanView) -> None:
    """What the numbers mean, and what speaks against them."""
    evaluation = view.evaluation
    levels = {line.estimate.level for line in view.lines if line.estimate}
    sentences = []
    if evaluation and levels:
        method = method_name(evaluation.default_method)
        sentences.append(
            f"Estimated return: E[r_end + discounted step rewards] over {evaluation.horizon_steps} steps (gamma {evaluation.gamma:g}) by "
            f"{method}, with its {100 * min(levels):.0f} % interval, as ranked on {evaluation.created_at:%Y-%m-%d}. Energy of a policy: "
            "predicted mean squared amplitude fraction."
        )
    if any(line.estimate and not line.estimate.supported for line in view.lines):
        sentences.append("* The data do not support this estimate.")
    sentences.append("Start: h:mm from the start of the first session. Washout: pause on the clinical stimulation after the session.")
    pdf.set_font("Helvetica", "", 8)
    pdf.set_text_color(*_MUTED)
    pdf.multi_cell(_WIDTH, 3.8, latin(" ".join(sentences)), align="L", new_x=XPos.LMARGIN, new_y=YPos.NEXT)
    pdf.ln(1.5)
    if view.warnings:
        pdf.set_text_color(*_INK)
        pdf.set_font("Helvetica", "B", 9)
        text = "   ".join(f"! {wording.warning(found)}" for found in view.warnings)
        for policy in (line.policy for line in view.lines if line.policy):
            text = text.replace(f"'{policy.name}'", f"'{_printed_name(policy)}'")
        pdf.multi_cell(_WIDTH, 4.2, latin(text), align="L", new_x=XPos.LMARGIN, new_y=YPos.NEXT)


def _paragraph(pdf: _Sheet, title: str, text: str) -> None:
    pdf.set_text_color(*_INK)
    pdf.set_font("Helvetica", "", 9)
    pdf.multi_cell(_WIDTH, 4.4, latin(f"{title}: {text}"), align="L", new_x=XPos.LMARGIN, new_y=YPos.NEXT)
    pdf.ln(2)


def _closing(pdf: _Sheet, view: PlanView) -> None:
    """Stop rules and signatures, kept together on one page."""
    if pdf.will_page_break(_CLOSING_MM):
        pdf.add_page()
    pdf.ln(1)
    pdf.set_text_color(*_INK)
    pdf.set_font("Helvetica", "B", 9)
    pdf.cell(0, 5, "Stop rules", new_x=XPos.LMARGIN, new_y=YPos.NEXT)
    pdf.set_font("Helvetica", "", 9)
    pdf.multi_cell(_WIDTH, 4.4, wording.STOP_RULES, align="L", border=1, padding=1.5, new_x=XPos.LMARGIN, new_y=YPos.NEXT)
    line_y, width = pdf.get_y() + 12, 86.0
    who = "name, signature, date"
    signers = (f"Clinician in charge: {who}", f"Study engineer: {who}", "Back on clinical settings: time, initials")
    pdf.set_font("Helvetica", "", 8)
    pdf.set_text_color(*_MUTED)
    pdf.set_draw_color(*_INK)
    for i, signer in enumerate(signers):
        x = pdf.l_margin + i * (width + 9.5)
        pdf.line(x, line_y, x + width, line_y)
        pdf.text(x, line_y + 3.8, signer)
    pdf.set_draw_color(*_LINE)
    pdf.set_y(line_y + 5)
