"""Sentences and the one page about a check, for the study's file; made of typed values at the last moment."""

from __future__ import annotations

import math
from datetime import UTC, datetime
from html import escape

from ml.deploy.ports.check import NOT, SAME, Fault, PortCheck

_EPOCH = datetime(1980, 1, 1, tzinfo=UTC)
_SCOPE = "The check is about the 400 windows of the bundle alone: not about the device's clock, its link or its stimulator."
_STYLE = """
@page { size: A4; margin: 12mm 14mm; }
body { font: 9.5pt/1.4 system-ui, Roboto, Arial, sans-serif; color: #14202b; max-width: 182mm; margin: 0 auto; }
h1 { font-size: 17pt; margin: 0 0 2px; } h2 { font-size: 10pt; margin: 12px 0 3px; }
.ban, .good { border: 2px solid #a3261c; color: #8a1c13; padding: 7px 10px; margin: 10px 0; }
.good { border-color: #2f6b46; color: #22523a; }
table { border-collapse: collapse; width: 100%; } th, td { text-align: left; padding: 2px 8px 2px 0; border-top: 1px solid #e4e9ed; }
th { font-weight: 400; color: #51606d; } td.n { text-align: right; font-variant-numeric: tabular-nums; }
code { font: 8pt/1.35 ui-monospace, "DejaVu Sans Mono", Consolas, monospace; overflow-wrap: anywhere; }
.lines { display: grid; grid-template-columns: 1fr 1fr; gap: 26px; margin-top: 34px; }
.lines div { border-top: 1px solid #14202b; padding-top: 3px; color: #51606d; }
"""


def verdict_words(check: PortCheck) -> str:
    """Write the verdict in a few words."""
    if check.verdict == NOT:
        return "not this policy: not to be connected"
    return "same" if check.verdict == SAME else f"within {_at_most(check.worst_ma or 0.0)} mA"


def headline(check: PortCheck, target: str) -> str:
    """Write the check in one line: of which copy, its most serious fault, and the verdict."""
    if check.verdict != NOT:
        return f"{target}: {verdict_words(check)}"
    fault = f"{fault_words(check.faults[0], check)}: " if check.faults else ""
    return f"{target}: {fault}not to be connected"


def fault_words(fault: Fault, check: PortCheck) -> str:
    """Write a fault as a clause that begins in lower case."""
    v, many = fault.value, f"{fault.count} windows"
    sentences = {
        "lost_sample": f"a lost sample gets {_range(fault)}",
        "lost_decision": f"after a lost sample {_range(fault)} are delivered instead of cDBS, {ma(fault.due)} mA ({many})",
        "order": f"the window is read in another order: {v}",
        "wrap": f"beta from {_plain(v)} on wraps round to -{_plain(v)}",
        "cut": f"beta above {_plain(v)} is misread ({many})",
        "rounded": f"weights are rounded to {v} decimals, with the scaling folded in ({many} wrong)",
        "unit": f"the answers are {v} instead of the fraction of cDBS",
        "outside": f"answers lie outside 0 to {ma(check.cdbs_ma)} mA ({_range(fault)}): the clip is gone",
        "full_dose": f"the largest dose is {ma(_number(v))} mA instead of {ma(fault.due)} mA",
        "least_dose": f"the least dose is {ma(_number(v))} mA instead of {ma(fault.due)} mA",
        "no_answer": f"{many} without a lost sample have no answer",
        "monotone": "the dose neither only rises nor only falls with the level of beta, as the policy's does",
        "limits": f"amplitudes leave the clinician's limits ({_range(fault)}, {many})",
        "differs": "no window could be compared" if v is None else f"the dose differs by up to {ma(_number(v))} mA ({many})",
    }
    return sentences[fault.code]


_GUARD = "Put the guard in front of the network: a window with a lost sample gets the cDBS amplitude, and the network is not asked."
_ADVICE = {
    "lost_sample": _GUARD,
    "lost_decision": _GUARD,
    "order": "Convert from the 2-D input [N, W], and compare the order of the converted input with the bundle's: oldest first.",
    "wrap": "Choose a number format that holds ten times the largest beta, and saturates.",
    "cut": "Choose a number format, and a calibration, that hold ten times the largest beta.",
    "rounded": "Keep the scaling (beta - mean) / std as a step of its own, in floating point, in front of the network.",
    "unit": "Answer with the fraction of the cDBS amplitude, 0 to 1.",
    "outside": "Put the clip behind the network again, in code.",
    "full_dose": "Calibrate on the port vectors, up to ten times the largest beta, or convert without quantising.",
    "least_dose": "Calibrate on the port vectors, up to ten times the largest beta, or convert without quantising.",
}


def advice(check: PortCheck) -> list[str]:
    """List what to do about the faults, each once."""
    return list(dict.fromkeys(_ADVICE[f.code] for f in check.faults if f.code in _ADVICE))


def facts(check: PortCheck) -> list[tuple[str, str]]:
    """List what was found, label and text."""
    lost = "no number, or cDBS: right"
    if check.lost_numbers:
        lost = f"a dose in {check.lost_numbers} of {check.lost_windows} windows, {ma(check.lost_low_ma)} to {ma(check.lost_high_ma)} mA"
    ends = [("Largest dose", check.highest_ma, check.highest_due_ma), ("Least dose", check.lowest_ma, check.lowest_due_ma)]
    rising = "as the policy's" if check.monotone else "no, and the policy's is"
    return [
        ("Largest difference", "nothing could be compared" if check.worst_ma is None else f"{ma(check.worst_ma)} mA"),
        *((label, f"{ma(given)} mA, due {ma(due)} mA") for label, given, due in ends if given is not None),
        ("A lost sample gets", lost if "network" in check.compared or check.lost_numbers else "see the decisions"),
        *([("Only rises or falls with beta", rising)] if check.monotone_due else []),
        ("Compared", " and ".join({"network": "the network", "decision": "the whole decision"}[name] for name in check.compared)),
    ]


def lines(check: PortCheck, target: str) -> str:
    """Write the check for a terminal."""
    rows = [f"{label + ':':<31}{text}" for label, text in facts(check)]
    kinds = [f"  {k.kind:<14}{k.answered:>4} of {k.windows:<4}{_worst(k.worst_ma)}" for k in check.by_kind]
    faults = [f"fault: {fault_words(fault, check)}" for fault in check.faults]
    head = f"{target}, port of policy {check.policy_name} of {check.participant}: {verdict_words(check)}"
    return "\n".join(
        [head, *faults, *(f"to do: {text}" for text in advice(check)), *rows, "by kind of window, largest difference:", *kinds]
    )


def page(check: PortCheck, target: str, when: str) -> str:
    """Render the page for the study's file.

    Args:
        target: what was converted, by what. when: day of the check, as it is to be printed.
    """
    box = "".join(f"{_sentence(fault_words(f, check))}<br>" for f in check.faults)
    todo = "".join(f"<li>{escape(text)}</li>" for text in advice(check))
    kinds = "".join(
        f"<tr><td>{escape(k.kind)}</td><td class=n>{k.windows}</td><td class=n>{k.answered}</td><td class=n>{_worst(k.worst_ma)}</td>"
        f"<td class=n>{_worst(k.mean_ma)}</td></tr>"
        for k in check.by_kind
    )
    number = "" if check.policy_id is None else f", policy {check.policy_id}"
    hashes = "".join(f"<tr><th>{name}</th><td><code>{digest}</code></td></tr>" for name, digest in _digests(check))
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>Check of a port, {escape(check.participant)}</title><style>{_STYLE}</style></head><body>
<h1>{escape(check.participant)}: check of a port</h1>
<div>{escape(target)}, {escape(when)}. Copy of {escape(check.policy_name)}{number}; cDBS {check.cdbs_ma:g} mA.</div>
<div class="{"ban" if check.verdict == NOT else "good"}">{escape(_first_upper(verdict_words(check)))}.<br>{box}</div>
{f"<h2>What to do</h2><ol>{todo}</ol>" if todo else ""}
<h2>What was found</h2>
<table>{"".join(f"<tr><th>{escape(a)}</th><td>{escape(b)}</td></tr>" for a, b in facts(check))}</table>
<h2>Difference by kind of window, mA</h2>
<table><tr><th>Kind</th><th>Windows</th><th>Answered</th><th>Largest</th><th>Mean</th></tr>{kinds}</table>
<h2>SHA-256</h2><table>{hashes}</table>
<p>{escape(_SCOPE, quote=False)}</p>
<div class="lines"><div>Engineer, date: this copy was checked</div><div>Clinician, date: seen</div></div>
</body></html>
"""


def page_pdf(check: PortCheck, target: str, when: str) -> bytes:
    """Render the same page as PDF, the same bytes for the same check. Letters that the built-in font lacks become `?`."""
    from fpdf import FPDF  # loaded for this page alone

    pdf = FPDF(format="A4")
    pdf.set_creation_date(_EPOCH)
    pdf.set_margins(14, 12)
    pdf.set_auto_page_break(False)
    pdf.add_page()

    def write(text: str, size: float, style: str = "") -> None:
        pdf.set_font("Helvetica", style, size)
        pdf.multi_cell(0, size * 0.47, text.encode("latin-1", "replace").decode("latin-1"), new_x="LMARGIN", new_y="NEXT")

    number = "" if check.policy_id is None else f", policy {check.policy_id}"
    write(f"{check.participant}: check of a port", 16, "B")
    write(f"{target}, {when}. Copy of {check.policy_name}{number}; cDBS {check.cdbs_ma:g} mA.", 9)
    write(f"\n{_first_upper(verdict_words(check))}.", 12, "B")
    for title, texts in (
        ("", [f"{_first_upper(fault_words(f, check))}." for f in check.faults]),
        ("What to do", advice(check)),
        ("What was found", [f"{label}: {text}" for label, text in facts(check)]),
        (
            "Difference by kind of window, mA",
            [
                f"{k.kind}: {k.answered} of {k.windows} answered, largest {_worst(k.worst_ma)}, mean {_worst(k.mean_ma)}"
                for k in check.by_kind
            ],
        ),
        ("SHA-256", [f"{name}: {digest}" for name, digest in _digests(check)]),
    ):
        if title and texts:
            write(f"\n{title}", 10, "B")
        for text in texts:
            write(text, 8.5)
    write(f"\n{_SCOPE}", 8.5)
    write("\n\nEngineer, date: this copy was checked ____________________     Clinician, date: seen ____________________", 8.5)
    return bytes(pdf.output())


def _digests(check: PortCheck) -> tuple[tuple[str, str], ...]:
    hashes = (check.bundle_sha256, check.model_sha256, check.vectors_sha256, check.answers_sha256)
    return tuple(zip(("Bundle", "Network", "Vectors", "Answers"), hashes, strict=True))


def ma(value: float | None) -> str:
    """Format a dose: two decimals, more where that would hide it."""
    if value is None:
        return "no"
    if 0 < abs(value) < 1e-4:
        return "less than 0.0001"
    return f"{value:.2f}" if value == 0 or abs(value) >= 0.005 else f"{value:.1g}"


def _at_most(value: float) -> str:
    """Round a difference up to one digit, in thousandths of a milliampere or finer: what is promised is kept."""
    digit = 10.0 ** min(-3, math.floor(math.log10(value))) if value > 0 else 1e-3
    return f"{math.ceil(value / digit - 1e-9) * digit:.6g}"


def _worst(value: float | None) -> str:
    return "not compared" if value is None else ma(value)


def _range(fault: Fault) -> str:
    if fault.low is None or fault.high is None:
        return "no amplitude"
    return f"{ma(fault.low)} mA" if ma(fault.low) == ma(fault.high) else f"{ma(fault.low)} to {ma(fault.high)} mA"


def _number(value: float | str | None) -> float | None:
    return None if value is None or isinstance(value, str) else value


def _plain(value: float | str | None) -> str:
    return f"{value:.4g}" if isinstance(value, float | int) else str(value)


def _sentence(clause: str) -> str:
    return escape(_first_upper(clause)) + "."


def _first_upper(text: str) -> str:
    return text[:1].upper() + text[1:]
