"""The one-page sheet of a bundle: HTML that prints on one A4 page, for the clinician who answers for the limits."""

from __future__ import annotations

import re
from datetime import datetime
from html import escape

from ml.deploy.manifest import BundleManifest, PlanCard
from ml.deploy.wording import battery_words, energy_words, warning_sentences

_STYLE = """
@page { size: A4; margin: 10mm 14mm; }
* { box-sizing: border-box; }
body { font: 9pt/1.33 system-ui, "Segoe UI", Roboto, "Helvetica Neue", Arial, sans-serif; color: #14202b; max-width: 182mm;
       margin: 0 auto; padding: 8px 0; background: #fff; }
header { display: flex; justify-content: space-between; align-items: flex-end; border-bottom: 2.5px solid #14202b; padding-bottom: 6px; }
h1 { font-size: 21pt; line-height: 1.1; margin: 0; letter-spacing: -.01em; overflow-wrap: anywhere; }
h2 { font-size: 8.4pt; letter-spacing: .07em; text-transform: uppercase; color: #51606d; margin: 9px 0 2px; }
.kind { color: #51606d; text-align: right; white-space: nowrap; padding-left: 24px; }
.ban { border: 2px solid #a3261c; color: #8a1c13; padding: 6px 10px; margin-top: 10px; font-weight: 650; }
.warn { border: 1.5px solid #b7791f; background: #fdf6e7; color: #6b4407; padding: 5px 10px; margin-top: 6px; }
.signed { border: 1px solid #2f6b46; color: #22523a; padding: 5px 10px; margin-top: 10px; }
.big { display: grid; grid-template-columns: repeat(4, 1fr); border: 1px solid #c3ccd3; margin-top: 4px; }
.big div { padding: 6px 10px 7px; border-left: 1px solid #c3ccd3; }
.big div:first-child { border-left: 0; }
.big b { display: block; font-size: 17pt; line-height: 1.2; font-variant-numeric: tabular-nums; }
.big small, .muted { color: #51606d; }
.columns { display: grid; grid-template-columns: 5fr 6fr; column-gap: 22px; }
p { margin: 4px 0; }
table { border-collapse: collapse; width: 100%; }
th { text-align: left; font-weight: 400; color: #51606d; padding: 2px 10px 2px 0; vertical-align: top; width: 29%; }
td { padding: 2px 0; vertical-align: top; font-variant-numeric: tabular-nums; overflow-wrap: anywhere; }
.wide th { width: 18%; white-space: nowrap; }
@media print { body { padding: 0; } }
tr + tr > * { border-top: 1px solid #e4e9ed; }
code { font: 8pt/1.35 ui-monospace, "DejaVu Sans Mono", Consolas, monospace; overflow-wrap: anywhere; }
ol { margin: 2px 0 0; padding-left: 18px; }
svg { display: block; width: 100%; height: auto; margin-top: 6px; }
.lines { display: grid; grid-template-columns: 1fr 1fr; gap: 26px; margin-top: 30px; }
.lines div { border-top: 1px solid #14202b; padding-top: 3px; color: #51606d; font-size: 8.6pt; }
footer { margin-top: 10px; color: #51606d; font-size: 8.2pt; }
"""


def render(manifest: BundleManifest, model_sha256: str | None) -> str:
    """Render the sheet.

    Args:
        manifest: of the bundle, all but its files.
        model_sha256: of the ONNX file; None where a schedule runs.
    """
    if manifest.card is not None and manifest.card.blinded:
        return _blinded_sheet(manifest, manifest.card)
    number = "" if manifest.policy_id is None else f" · policy {manifest.policy_id}"
    what = "Network" if manifest.schedule is None else "Schedule"
    expected = "Amplitude" if manifest.card is not None and manifest.schedule is None else "Amplitude, energy, battery"
    code = escape(manifest.participant)
    side = f" · {manifest.hemisphere} hemisphere" if manifest.hemisphere else ""
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>Controller bundle {code}{escape(number.replace(" ·", ","))}</title><style>{_STYLE}</style></head><body>
<header><div><h1>{code}</h1>{escape(manifest.policy_name)} <span class="muted">{number}{side}</span></div>
<div class="kind">Closed-loop DBS controller<br>one-page sheet of the bundle</div></header>
{_approval(manifest)}
{_session(manifest)}
{_plan_card(manifest)}
{_warnings(manifest)}
<h2>Stimulation limits</h2>
<div class="big"><div><small>Lowest</small><b>{manifest.min_ma:g} mA</b></div><div><small>Highest</small><b>{manifest.max_ma:g} mA</b></div>
<div><small>cDBS = fraction 1</small><b>{manifest.cdbs_ma:g} mA</b></div>
<div><small>Ramp</small><b>{manifest.ramp_ma_per_s:g} mA/s</b></div></div>
{_scale(manifest)}
<p class="muted">{_source_of_limits(manifest)} {_device(manifest)}</p>
<div class="columns"><div>
<h2>Signal</h2><table>{_rows(_signal(manifest))}</table>
</div><div>
<h2>{what}</h2><table>{_rows(_network(manifest))}</table>
</div></div>
<h2>{expected}</h2>
<table class="wide">{_rows(_expectations(manifest))}</table>
<h2>When the controller gives way</h2>
<p style="margin:2px 0">Every {manifest.period_s:g} s it decides anew. In the same decision, and without a ramp, it returns to the cDBS
amplitude of <b>{manifest.cdbs_ma:g}&nbsp;mA</b> when beta has not come when it was due (older than {manifest.limits().stale_after_s:g} s),
is not a number, negative, {_implausible(manifest)}or of another unit or source, when the window is not
whole, or when the network fails. A window has {manifest.window} beta amplitudes in a row
({manifest.window * manifest.period_s:g} s){_imputation(manifest)}.
From cDBS the amplitude moves at most {manifest.ramp_ma_per_s * manifest.period_s:.4g} mA per period.</p>
{_before_use(code)}
<h2>Where it comes from</h2><table class="wide">{_rows(_origin(manifest, model_sha256))}</table>
{_SIGNED_BY}
<footer>{_made(manifest)} For research; betaloop is no medical device.</footer>
</body></html>
"""


_SIGNED_BY = """<div class="lines"><div>Clinician, date: limits checked against the stimulator</div>
<div>Engineer, date: bundle verified on the tablet</div></div>"""


def _blinded_sheet(m: BundleManifest, card: PlanCard) -> str:
    """Render the sheet of a session of a blinded plan: its letter, common limits and stop rules, and nothing that reveals what runs."""
    code = escape(m.participant)
    taken = f"First taken by {escape(re.sub(r'[.][0-9]{6} ', ' ', m.taken_by))}. " if m.taken_by else ""
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><meta name="viewport" content="width=device-width, initial-scale=1">
<title>Controller bundle {code}, blinded</title><style>{_STYLE}</style></head><body>
<header><div><h1>{code}</h1>{escape(card.head)}</div>
<div class="kind">Closed-loop DBS controller<br>one-page sheet of a blinded session</div></header>
{_approval(m)}
{_session(m)}
{_plan_card(m)}
<h2>Stop rules</h2><p>{escape(card.stop_rules)}</p>
{_before_use(code)}
{_SIGNED_BY}
<footer>{taken}Bundled by betaloop {escape(m.code_version)}. For research; betaloop is no medical device.</footer>
</body></html>
"""


def _plan_card(m: BundleManifest) -> str:
    """Repeat what the sheet of the signed plan says of this session, word for word."""
    if m.card is None or m.slot is None:
        return ""
    warned = "".join(f'<div class="warn">{escape(text)}</div>' for text in m.card.warnings)
    title = f"As on the sheet of plan {m.slot.plan_id}: {escape(m.card.head)}, {escape(m.card.minutes)}"
    return f'<h2>{title}</h2><table class="wide">{_rows(list(m.card.lines))}</table>{warned}'


def _before_use(code: str) -> str:
    return f"""<h2>Before use</h2>
<ol><li>Check the bundle on the tablet: <code>betaloop control --bundle FILE --key KEY --participant {code}</code> verifies signature, every
SHA-256, the test vectors and the participant.</li>
<li>Compare participant, hemisphere, contacts and cDBS amplitude with the stimulator. For this participant only.</li>
<li>Keep the clinical settings at hand: the sheet replaces neither the stop rules of the protocol nor the device's own limits.</li></ol>"""


def _approval(m: BundleManifest) -> str:
    if not m.approvals:
        return '<div class="ban">Not approved: not to be used on a participant.</div>'
    lines = "<br>".join(
        f"Approved by {escape(a.name)} ({escape(a.role)}), {escape(_when(a.approved_at))}: {escape(a.statement)}" for a in m.approvals
    )
    return f'<div class="signed">{lines}</div>'


def _session(m: BundleManifest) -> str:
    """Say which session of which visit it is for, and that it runs once."""
    slot = m.slot
    if slot is None:
        return '<div class="warn">For no session of a signed plan: runs on the bench alone, with nobody connected.</div>'
    label = f" · {escape(slot.label)}" if slot.label else ""
    told = m.card is None or not m.card.blinded  # a repeat of what is not to be known is not to be known either
    repeat = f", repeat {slot.repeat}" if slot.repeat > 1 and told else ""
    return (
        f'<div class="signed">Session {slot.position} of visit {slot.visit_number}{label}{repeat} · {slot.minutes:g} min · '
        f"<b>{escape(slot.visit_date)}</b> only, once. Plan {slot.plan_id}, signed as <code>{escape(slot.plan_sha256[:12])}</code>.</div>"
    )


def _imputation(m: BundleManifest) -> str:
    """Say how many lost ones a window may have, as the end of a sentence."""
    return f"; up to {m.most_imputed} lost ones are predicted, never the newest" if m.most_imputed else ""


def _implausible(m: BundleManifest) -> str:
    """List what else counts as beta that is not to be trusted, as part of a sentence."""
    found = [] if m.beta_max is None else [f"above {m.beta_max:.3g} {escape(m.beta_unit)}"]
    found += [] if m.frozen_after is None else [f"the same {m.frozen_after} times in a row"]
    if m.level_low is not None and m.level_high is not None:
        found.append(f"on average outside {m.level_low:.3g} to {m.level_high:.3g} {escape(m.beta_unit)}")
    return "".join(f"{text}, " for text in found)


def _made(m: BundleManifest) -> str:
    taken = f"First taken by {escape(re.sub(r'[.][0-9]{6} ', ' ', m.taken_by))}. " if m.taken_by else ""
    if m.schedule is not None:
        return f"{taken}Bundled by betaloop {escape(m.code_version)}."
    return f"{taken}Trained by betaloop {escape(m.policy_code_version)}, bundled by betaloop {escape(m.code_version)}."


def _when(text: str) -> str:
    """Format an ISO 8601 time for people; any other text stays as it is."""
    try:
        return f"{datetime.fromisoformat(text):%Y-%m-%d %H:%M %Z}".strip()
    except ValueError:
        return text


def _warnings(m: BundleManifest) -> str:
    texts = warning_sentences(m)
    return f'<div class="warn">{"<br>".join(escape(text) for text in texts)}</div>' if texts else ""


def _source_of_limits(m: BundleManifest) -> str:
    if m.limits_stated_by is None:
        return "Nobody stated these limits: they are defaults, to be confirmed by the clinician."
    return f"Stated by {escape(m.limits_stated_by)}."


def _device(m: BundleManifest) -> str:
    if m.device_min_ma is None or m.device_max_ma is None:
        return "No recording held the stimulator's own limits: compare them by hand."
    return f"The stimulator's own limits, as last recorded: {m.device_min_ma:g} to {m.device_max_ma:g} mA."


def _scale(m: BundleManifest) -> str:
    """Draw the amplitudes to scale: the stimulator's own range, the clinician's within it, cDBS marked."""
    top = max(m.max_ma, m.device_max_ma or 0.0) * 1.04

    def x(ma: float) -> float:
        return 8 + 684 * ma / top

    device = ""
    if m.device_max_ma is not None and m.device_min_ma is not None:
        low, high = x(m.device_min_ma), x(m.device_max_ma)
        device = f'<rect x="{low:.1f}" y="16" width="{high - low:.1f}" height="12" fill="none" stroke="#8b98a3" stroke-dasharray="4 3"/>'
    marks = {0.0: "0", m.min_ma: f"{m.min_ma:g}", m.max_ma: f"{m.max_ma:g}"}
    labels = "".join(f'<text x="{x(ma):.1f}" y="43" text-anchor="middle">{text}</text>' for ma, text in marks.items())
    return (
        '<svg viewBox="0 0 700 48" role="img" aria-label="Amplitude limits in mA" font-size="11" fill="#51606d">'
        f'<line x1="8" y1="22" x2="692" y2="22" stroke="#c3ccd3"/>{device}'
        f'<rect x="{x(m.min_ma):.1f}" y="18" width="{max(x(m.max_ma) - x(m.min_ma), 1):.1f}" height="8" fill="#2b6c99"/>'
        f'<line x1="{x(m.cdbs_ma):.1f}" y1="13" x2="{x(m.cdbs_ma):.1f}" y2="31" stroke="#c1571b" stroke-width="2.5"/>{labels}'
        f'<text x="{min(x(m.cdbs_ma), 650):.1f}" y="10" text-anchor="middle" fill="#a8470f">cDBS {m.cdbs_ma:g} mA</text></svg>'
    )


def _signal(m: BundleManifest) -> list[tuple[str, str]]:
    scale = "inside the network"
    if m.normalisation_mean is not None:
        scale = f"(beta - {m.normalisation_mean:.5g}) / {m.normalisation_std:.5g}, inside"
    return [
        ("Beta", f"{m.beta_unit}, from {m.beta_source}"),
        ("Band", f"{m.beta_low_hz:g} to {m.beta_high_hz:g} Hz"),
        ("Window", f"{m.window} values, one per {m.period_s:g} s"),
        ("Valid share", f"{100 * m.min_valid_fraction:g} % of a period's samples"),
        *([("Scaling", scale)] if m.schedule is None else []),
    ]


def _network(m: BundleManifest) -> list[tuple[str, str]]:
    if m.schedule is not None:
        drawn = [] if m.schedule.seed is None else [("Seed", str(m.schedule.seed))]
        level = [] if m.schedule.level is None else [("Level", f"{m.schedule.level:.2f} of cDBS")]
        minutes = sum(hold.steps for hold in m.schedule.holds) * m.period_s / 60
        return [("Design", m.schedule.design), *level, *drawn, ("Amplitudes", f"{len(m.schedule.holds)} held, {minutes:.1f} min in all")]
    if not m.layers:
        return [("Form", f"ONNX only, without C header: {m.no_header or 'no layers are known'}")]
    rows = [
        ("Units", " → ".join(str(units) for units in m.layers) + ("" if "tanh" not in m.activations else f" ({', '.join(m.activations)})")),
        ("Size", f"{m.parameters} weights, {4 * m.parameters} bytes as float32"),
        ("Work", f"{m.macs} multiply-adds per decision"),
    ]
    if m.int8_bound is not None:
        planes = "two planes of int8" if m.int8_planes == 2 else "int8"
        bound = f"fraction within {m.int8_bound:.2g} ({m.int8_bound * m.cdbs_ma:.2g} mA)"
        rows.append(("Whole numbers", f"{m.int8_bytes} bytes, {planes}; {bound}"))
    if m.agreement_mean is not None:
        spread = f"mean {m.agreement_mean:.3g}, 99 % within {m.agreement_p99:.3g}, worst {m.agreement_worst:.3g} of the fraction"
        rows.append(("Difference", f"from teacher {m.teacher_name or 'unknown'}: {spread}"))
    return rows


def _expectations(m: BundleManifest) -> list[tuple[str, str]]:
    """List what the policy requests on logged beta, or the schedule delivers, and what follows for energy and battery."""
    if m.schedule is not None:
        fractions = [hold.amplitude for hold in m.schedule.holds for _ in range(hold.steps)]
        given = [min(max(a * m.cdbs_ma, m.min_ma), m.max_ma) / m.cdbs_ma for a in fractions]
        mean, square = sum(given) / len(given), sum(a * a for a in given) / len(given)
        lowest = f"{min(given) * m.cdbs_ma:.2f} to {max(given) * m.cdbs_ma:.2f} mA, {mean * m.cdbs_ma:.2f} mA on average"
        return [("Delivered", lowest), ("Energy", f"{energy_words(square)}, as scheduled")]
    if m.asked_mean is None or m.energy_of_cdbs is None or m.charge_of_cdbs is None:
        return [("Not known", "no beta of this participant was logged with this window: neither amplitude nor energy can be estimated")]
    asked = f"{m.asked_mean * m.cdbs_ma:.2f} mA on average over {m.test_windows} recorded windows ({m.test_windows_from})"
    below = f"below {m.min_ma:g} mA (lowest) in {100 * (m.asked_below_minimum or 0):.0f} %"
    if m.logged_bound_ma is not None and m.asked_below_bound is not None:
        below += f", below {m.logged_bound_ma:.4g} mA (B, lowest tried at random) in {100 * m.asked_below_bound:.0f} %"
    if m.card is not None:  # the card has the prediction of the session, so no second number of it here
        return [("Asked for", f"{asked}; {below}. On logged beta: in closed loop beta answers to the amplitude.")]
    return [
        ("Asked for", f"{asked}; {below}"),
        ("Energy", f"{battery_words(m.energy_of_cdbs, m.charge_of_cdbs)}. On logged beta: in closed loop beta answers to the amplitude."),
    ]


def _origin(m: BundleManifest, model_sha256: str | None) -> list[tuple[str, str]]:
    network = [
        ("Network SHA-256", model_sha256 or ""),
        ("Snapshot SHA-256", m.snapshot_sha256 or "none: trained outside this study"),
    ]
    return [
        *(network if m.schedule is None else []),
        ("Signing key", m.public_key or "not signed"),
    ]


def _rows(rows: list[tuple[str, str]]) -> str:
    return "".join(f"<tr><th>{escape(name)}</th><td>{_value(name, text)}</td></tr>" for name, text in rows)


def _value(name: str, text: str) -> str:
    return f"<code>{escape(text)}</code>" if "SHA-256" in name or "key" in name else escape(text)
