"""The visit plan on paper: A4 landscape, the built-in PDF fonts, readable in black and white.

One card per session: what runs, within which limits, what is predicted, what speaks against it, and blanks to fill in by hand. A plan that
is not approved says so across every page.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime

from fpdf import FPDF
from fpdf.enums import XPos, YPos

from app.planning.plans import wording
from app.planning.plans.view import PlanView, shown
from app.planning.sheet.cards import WIDTH, draw_cards
from app.planning.sheet.content import HASH
from app.planning.sheet.ink import INK, LINE, MUTED, clock, latin, shade
from app.platform.audit.signatures import SignatureState
from app.study.cdbs_amplitude import held_settings
from app.study.characteristics import MEDICATION, characteristics_words, fields_of
from app.study.doses import doses_words
from ml.outcomes import ALL

_CLOSING_MM = 32.0


class _Sheet(FPDF):  # type: ignore[misc]
    """Pages with the plan's name above, provenance and page number below, and DRAFT across where it is one."""

    def __init__(self, view: PlanView, printed_by: str, printed_at: datetime) -> None:
        super().__init__("landscape", "mm", "A4")
        self._view, self._printed = view, f"Printed {printed_at:%Y-%m-%d %H:%M} UTC by {printed_by}"
        self.set_margins(10, 9, 10)
        self.set_auto_page_break(True, 14)
        self.set_draw_color(*LINE)
        self.set_line_width(0.2)
        self.c_margin = 0.0  # text begins where boxes begin
        self.set_creation_date(printed_at)
        self.set_title(latin(f"Visit plan {view.visit.participant.code}, visit {view.visit.number}"))
        self.set_creator("betaloop")

    def header(self) -> None:
        plan, visit = self._view.plan, self._view.visit
        self.set_text_color(*INK)
        self.set_font("Helvetica", "B", 17)
        self.cell(0, 8, latin(f"Visit plan  {visit.participant.code}{' (synthetic)' * visit.participant.synthetic}  visit {visit.number}"))
        self.set_xy(self.l_margin, self.t_margin)
        self.set_font("Helvetica", "", 11)
        day = visit.date.strftime("%A, %d %B %Y") if visit.date else "Date: ____________________"
        self.cell(0, 8, day, align="R", new_x=XPos.LMARGIN, new_y=YPos.NEXT)
        self.set_font("Helvetica", "", 9)
        self.set_text_color(*MUTED)
        self.cell(0, 5, latin(f"Drafted by {plan.created_by}, {plan.created_at:%Y-%m-%d %H:%M} UTC.  {_approval(self._view)}."))
        self.ln(7)

    def footer(self) -> None:
        plan, evaluation = self._view.plan, self._view.evaluation
        ranking = f"evaluation {evaluation.id}, snapshot {evaluation.snapshot_id}" if evaluation else "no evaluation"
        seed = "" if self._view.sealed else f"seed {plan.seed}, "
        self.set_y(-12)
        self.set_font("Helvetica", "", 8)
        self.set_text_color(*MUTED)
        self.cell(0, 5, latin(f"betaloop \u00b7 plan {plan.id}, {seed}{ranking} \u00b7 {self._printed}"))
        self.set_x(self.l_margin)
        self.cell(0, 5, f"Page {self.page_no()} of {{nb}}", align="R")
        if plan.status != "approved":
            self._watermark(plan.status.upper())
        elif self._view.signature_state is SignatureState.BROKEN:
            self._watermark("DO NOT RUN")

    def _watermark(self, word: str) -> None:
        """Print a word over everything, so that no filled cell hides it, and faint, so that it hides nothing."""
        self.set_font("Helvetica", "B", 120)
        self.set_text_color(*INK)
        width = self.get_string_width(word)
        with self.local_context(fill_opacity=0.09), self.rotation(25, self.w / 2, self.h / 2):
            self.text((self.w - width) / 2, self.h / 2 + 14, word)


def _approval(view: PlanView) -> str:
    """Describe who signed, or why nothing here may be run."""
    plan = view.plan
    if plan.approved_at is None:
        return "NOT APPROVED: not for use with a participant"
    if view.signature_state is SignatureState.BROKEN:
        return "SIGNATURE BROKEN: changed after it was signed, not for use with a participant"
    by = f"Approved by {plan.approved_by}, {plan.approved_at:%Y-%m-%d %H:%M} UTC"
    return f"{by}, signature {view.signature.sha256[:12]}" if view.signature else by


def render(
    view: PlanView,
    bundles: Mapping[int, str],
    ports: Mapping[int, str],
    printed_by: str,
    printed_at: datetime,
    standings: Sequence[str] = (),
) -> bytes:
    """Render the sheet of a plan as PDF bytes.

    Args:
        view: the plan. bundles: SHA-256 of the newest bundle that was taken for a session, by the number of its plan item.
        ports: checks of converted copies, by the number of the policy.
        printed_by: who printed it. printed_at: when; printed on the page and in the document's metadata.
        standings: sentences on the policies.
    """
    view = shown(view)
    pdf = _Sheet(view, printed_by, printed_at)
    pdf.add_page()
    _timeline(pdf, view)
    _circumstances(pdf, view)
    if view.plan.note:
        _paragraph(pdf, "Note", view.plan.note)
    for text in standings:
        _paragraph(pdf, "Standing", text)
    draw_cards(pdf, view, bundles, ports)
    _designs(pdf, view)
    _reading(pdf, view)
    _closing(pdf, view)
    return bytes(pdf.output())


def _timeline(pdf: _Sheet, view: PlanView) -> None:
    """Draw the day to scale, washouts left white."""
    scale, top, height = WIDTH / view.total_minutes, pdf.get_y(), 8.0
    pdf.set_text_color(*INK)
    pdf.set_font("Helvetica", "", 8)
    for line in view.lines:
        x, width = pdf.l_margin + line.start_minute * scale, line.item.minutes * scale
        pdf.set_fill_color(*shade(line))
        pdf.rect(x, top, width, height, style="DF")
        label = f"{line.item.position}  {wording.session_name(line.item)}"
        if pdf.get_string_width(label) > width - 2:
            label = str(line.item.position)
        pdf.set_xy(x, top)
        pdf.cell(width, height, label, align="C")
        if width > pdf.get_string_width(clock(line.start_minute, view.plan.starts_at)):
            pdf.text(x, top + height + 3.4, clock(line.start_minute, view.plan.starts_at))
    end = clock(view.total_minutes, view.plan.starts_at)
    last = view.lines[-1].item.minutes * scale
    if last > 2 * pdf.get_string_width(end) + 2:
        pdf.text(pdf.l_margin + WIDTH - pdf.get_string_width(end), top + height + 3.4, end)
    pdf.set_xy(pdf.l_margin, top + height + 5.5)


def _circumstances(pdf: _Sheet, view: PlanView) -> None:
    """Print the stimulation that the day starts from, and blanks for what else bears on it."""
    stated = [
        f"{a.hemisphere} {a.amplitude_ma:g} mA" + (f" (program {a.program})" if a.program else "") for a in view.visit.cdbs_amplitudes
    ]
    usual = held_settings(view.visit, view.visit.participant.current_settings).cdbs_amplitude_ma
    amplitude = ", ".join(stated) or (f"{usual:g} mA" if usual else "__________ mA")
    pdf.set_text_color(*INK)
    pdf.set_font("Helvetica", "", 9)
    pdf.cell(0, 6, latin(f"cDBS amplitude: {amplitude}    Stimulation site and program: {'_' * 50}"), new_x=XPos.LMARGIN, new_y=YPos.NEXT)
    participant = view.visit.participant
    known = characteristics_words(fields_of(participant.current_characteristics))
    planned = {MEDICATION: known.pop(MEDICATION)}
    for told in (known, planned, {"Taken so far (UTC)": doses_words(view.visit.doses)}):
        if text := "    ".join(f"{title}: {words}" for title, words in told.items() if words):
            pdf.multi_cell(WIDTH, 4.4, latin(text), align="L", new_x=XPos.LMARGIN, new_y=YPos.NEXT)
    pdf.cell(0, 6, latin(f"Medication taken, with times: {'_' * 100}"), new_x=XPos.LMARGIN, new_y=YPos.NEXT)
    pdf.ln(1)


def _designs(pdf: _Sheet, view: PlanView) -> None:
    """Print what each random session tries and never does: it is signed with the plan."""
    for line in view.lines:
        if line.design is None:
            continue
        text = f"Session {line.item.position}: {wording.design_words(line.design)}"
        pdf.set_text_color(*INK)
        if not line.design.holds:
            pdf.set_font("Helvetica", "", 8)
            pdf.multi_cell(WIDTH, 3.8, latin(f"{text}."), align="L", new_x=XPos.LMARGIN, new_y=YPos.NEXT)
            continue
        pdf.set_font("Helvetica", "B", 8)
        text = f"{text}, seed {line.design.seed}; {wording.bound_words(line.design, line.design.bounds)}."
        pdf.multi_cell(WIDTH, 3.8, latin(text), align="L", new_x=XPos.LMARGIN, new_y=YPos.NEXT)
        pdf.set_font("Helvetica", "", 8)
        unit = "mA" if line.design.bounds else "fraction of cDBS"
        words = f"min:s and {unit}:  {wording.schedule_words(line.design, line.design.bounds)}"
        pdf.multi_cell(WIDTH, 3.8, latin(words), align="L", new_x=XPos.LMARGIN, new_y=YPos.NEXT)
        pdf.ln(1)
    pdf.ln(1)


def _reading(pdf: _Sheet, view: PlanView) -> None:
    """Print what the numbers mean, and what speaks against them."""
    evaluation = view.evaluation
    sentences = []
    if evaluation and any(line.row for line in view.lines):
        sentences.append(
            f"Expected, and against cDBS: by the ranking of {evaluation.created_at:%Y-%m-%d}. Energy: the mean of the squared amplitude, "
            f"100 % under cDBS. Margins: how much worse {ALL} may be, set for this participant."
        )
    start = "by the clinic's clock" if view.plan.starts_at else "h:mm from the start of the first session"
    sentences.append(f"Start: {start}. Washout: pause on clinical stimulation after it. Bundle: first {HASH} characters of its hash.")
    pdf.set_font("Helvetica", "", 8)
    pdf.set_text_color(*MUTED)
    pdf.multi_cell(WIDTH, 3.8, latin(" ".join(sentences)), align="L", new_x=XPos.LMARGIN, new_y=YPos.NEXT)
    pdf.ln(1.5)
    on_cards = {line.policy.id for line in view.lines if line.policy}
    for found, text in wording.plain_warnings(view.warnings):
        if found.policy_id in on_cards:
            continue
        pdf.set_text_color(*INK)
        pdf.set_font("Helvetica", "B", 8.5)
        pdf.multi_cell(WIDTH, 4.2, latin(f"! {text}"), align="L", new_x=XPos.LMARGIN, new_y=YPos.NEXT)


def _paragraph(pdf: _Sheet, title: str, text: str) -> None:
    pdf.set_text_color(*INK)
    pdf.set_font("Helvetica", "", 9)
    pdf.multi_cell(WIDTH, 4.4, latin(f"{title}: {text}"), align="L", new_x=XPos.LMARGIN, new_y=YPos.NEXT)
    pdf.ln(2)


def _closing(pdf: _Sheet, view: PlanView) -> None:
    """Stop rules and signatures, kept together on one page."""
    if pdf.will_page_break(_CLOSING_MM):
        pdf.add_page()
    pdf.ln(1)
    pdf.set_text_color(*INK)
    pdf.set_font("Helvetica", "B", 9)
    pdf.cell(0, 5, "Stop rules", new_x=XPos.LMARGIN, new_y=YPos.NEXT)
    pdf.set_font("Helvetica", "", 9)
    pdf.multi_cell(WIDTH, 4.4, wording.STOP_RULES, align="L", border=1, padding=1.5, new_x=XPos.LMARGIN, new_y=YPos.NEXT)
    line_y, width = pdf.get_y() + 9, 86.0
    who = "name, signature, date"
    signers = (f"Clinician in charge: {who}", f"Study engineer: {who}", "Back on clinical settings: time, initials")
    pdf.set_font("Helvetica", "", 8)
    pdf.set_text_color(*MUTED)
    pdf.set_draw_color(*INK)
    for i, signer in enumerate(signers):
        x = pdf.l_margin + i * (width + 9.5)
        pdf.line(x, line_y, x + width, line_y)
        pdf.text(x, line_y + 3.8, signer)
    pdf.set_draw_color(*LINE)
    pdf.set_y(line_y + 5)
