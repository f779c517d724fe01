"""The sheet of a threshold rule: settings of an implant that come closest to a policy, to be typed into its programmer by a clinician."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime
from typing import Any

from fastapi import Response
from pydantic import Field
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.evaluation.ranking.verdict_wording import STANDING_NAMES
from app.pipeline.params import THRESHOLD_RULE
from app.planning.bundles.service import refuse_after_events
from app.planning.plans import repository as plans
from app.planning.plans.limits import device_limits
from app.platform.audit import record
from app.platform.database import now
from app.platform.errors import Conflict, Invalid, NotFound
from app.platform.jobs import repository as jobs
from app.platform.numbers import ma, number
from app.platform.web.schemas import Model
from app.study import access, cdbs_amplitude
from app.tables.jobs import Job, JobStatus
from app.tables.learning import Policy
from app.tables.participants import Hemisphere, Participant
from ml.policies.threshold_rule import AVERAGING_S, LIMIT_MA, ONSET_S, RAMP_S, RuleError, ThresholdRule

INK, MUTED, LINE = (20, 30, 38), (95, 108, 118), (150, 160, 168)
MOST_JOBS = 200
MOST_PLANS = 50
PERCEPT = "percept_lfp"
"""The one source of beta that is the power of the device itself, in its own unit."""
SOURCES = (
    "Ranges: FDA, Summary of Safety and Effectiveness Data P960009/S478 (2025), Table 2; averaging: tip card of sensing (2020).",
    "Defaults: Stanslaski et al., npj Parkinson's Disease 10:174 (2024). Steps of the amplitude: Cascino et al., npj Parkinson's Disease "
    "(2026).",
)


@dataclass(frozen=True)
class Bounds:
    """Amplitudes that a rule of this participant may use now, mA, and the cDBS amplitude."""

    cdbs_ma: float
    min_ma: float
    max_ma: float
    source: str


def bounds_in_force(db: Session, participant: Participant, hemisphere: Hemisphere | None) -> Bounds:
    """Find the bounds of the newest plan with limits for policies, the strictest of its sessions.

    Without such a plan they are the stimulator's own limits and the cDBS amplitude. Nothing is ever above the cDBS amplitude.

    Raises:
        Invalid: the cDBS amplitude is not known, or is stated for both sides and none is named.
    """
    cdbs_ma = cdbs_amplitude.in_force_now(participant, hemisphere)
    for plan, visit in plans.plans(db, participant.id, MOST_PLANS, 0)[0]:
        items = [i for i in plan.items if i.policy_id is not None and (hemisphere is None or i.hemisphere in (None, hemisphere))]
        lowest, highest = [i.min_ma for i in items if i.min_ma is not None], [i.max_ma for i in items if i.max_ma is not None]
        if plan.status != "superseded" and lowest and highest:
            return Bounds(cdbs_ma, max(lowest), min(*highest, cdbs_ma), f"the plan of visit {visit.number}")
    device = device_limits(db, participant, hemisphere)
    if device is not None:
        return Bounds(cdbs_ma, device.min_ma, min(device.max_ma, cdbs_ma), "the stimulator's own limits and the cDBS amplitude")
    return Bounds(cdbs_ma, 0.0, cdbs_ma, "the cDBS amplitude")


class SettingOut(Model):
    """One setting as it is typed into the programmer."""

    name: str = Field(description="Field of `rule`, or `sensing`, `paused_ma`, `lower_threshold` and `upper_threshold`.")
    label: str
    value: str
    unit: str
    device_takes: str = Field(description="Range of the device, as published; empty where none is.")


class PromiseOut(Model):
    """One estimate of what the rule returns, with its interval."""

    value: float
    low: float
    high: float


class RuleSheetOut(Model):
    """Settings of an implant that come closest to a policy, and what is lost by them."""

    participant: str
    policy_id: int
    policy_name: str
    job_id: str
    made_at: datetime
    hemisphere: Hemisphere | None
    device: str
    cdbs_ma: float
    min_ma: float
    max_ma: float
    rule: dict[str, Any] = Field(description="Every setting by name; thresholds in the unit of the sessions' beta.")
    beta_unit: str
    beta_source: str
    thresholds_in_device_unit: bool = Field(
        description="Whether the thresholds are power of the device itself. Else they are set in clinic."
    )
    below_threshold: list[float] = Field(description="Shares of the recorded beta that are not above the lower and the upper threshold.")
    settings: list[SettingOut]
    adaptive: bool = Field(description="False where both limits are the same: the closest rule is a constant amplitude.")
    close: bool = Field(description="Whether the rule is close enough to the policy for the promises to hold.")
    difference_rms_ma: float = Field(description="Root mean squared difference in amplitude from the policy, over recorded beta.")
    difference_mean_ma: float = Field(description="Mean of the rule less the policy.")
    energy_rule: float = Field(description="Mean squared fraction over recorded beta, by the device's own time steps; cDBS is 1.")
    energy_policy: float
    return_rule: PromiseOut
    return_policy: PromiseOut
    return_cdbs: PromiseOut
    to_policy: PromiseOut = Field(description="Estimated return of the rule less that of the policy.")
    to_cdbs: PromiseOut = Field(description="Estimated return of the rule less that of cDBS.")
    verdict: str = Field(description="Of the rule itself, by the participant's margins.")
    sessions: int
    steps: int
    snapshot_id: int
    rules_tried: int
    warnings: list[str]
    refused: str | None = Field(description="Why nothing may be programmed by this sheet; null where it may.")


def newest_job(db: Session, participant: Participant, policy: Policy, status: Sequence[JobStatus] = ()) -> Job | None:
    """Find the newest job that looked for this policy's rule; None where none did."""
    found, _ = jobs.find(db, participant.id, THRESHOLD_RULE, status, MOST_JOBS)
    return next((job for job in found if job.params.get("policy_id") == policy.id), None)


def rule_sheet(db: Session, participant: Participant, policy: Policy) -> RuleSheetOut:
    """Build the newest sheet of a policy's rule, checked against what is in force now.

    Raises:
        NotFound: no rule was found yet.
    """
    job = newest_job(db, participant, policy, [JobStatus.SUCCEEDED])
    if job is None or job.result is None:
        raise NotFound(f"No rule was found for policy '{policy.name}' yet.", "Start a job of kind 'threshold_rule'.")
    found, rule = job.result, ThresholdRule.from_json(job.result["rule"])
    adaptive, own_unit = rule.lower_ma < rule.upper_ma, found["beta"]["source"] == PERCEPT
    estimates = found["estimates"]
    return RuleSheetOut(
        participant=participant.code,
        policy_id=policy.id,
        policy_name=policy.name,
        job_id=job.id,
        made_at=job.finished_at or job.created_at,
        hemisphere=found["hemisphere"],
        device=found["device"],
        **{name: found[name] for name in ("cdbs_ma", "min_ma", "max_ma", "rule", "below_threshold", "close", "sessions", "steps")},
        beta_unit=found["beta"]["unit"],
        beta_source=found["beta"]["source"],
        thresholds_in_device_unit=own_unit,
        settings=setting_rows(rule, found, own_unit),
        adaptive=adaptive,
        difference_rms_ma=found["closeness"]["rms_ma"],
        difference_mean_ma=found["closeness"]["mean_ma"],
        energy_rule=found["closeness"]["energy_rule"],
        energy_policy=found["closeness"]["energy_policy"],
        return_rule=_promise(estimates["rule"]),
        return_policy=_promise(estimates["policy"]),
        return_cdbs=_promise(estimates["cdbs"]),
        to_policy=_promise(found["to_policy"]),
        to_cdbs=_promise(found["to_cdbs"]),
        verdict=found["verdict"]["code"],
        snapshot_id=found["snapshot_id"],
        rules_tried=found["tried"],
        warnings=_warnings(found, adaptive, own_unit),
        refused=_refusal(db, participant, policy, rule, found),
    )


def printable(db: Session, participant: Participant, policy: Policy, caller: Caller) -> RuleSheetOut:
    """Return the sheet for print.

    Raises:
        Forbidden: the caller may take no bundles. NotFound: no rule yet. Conflict: nothing may be programmed by it.
    """
    access.require(caller, can.TAKE_BUNDLES, participant)
    sheet = rule_sheet(db, participant, policy)
    if sheet.refused:
        raise Conflict(f"No sheet of the rule leaves: {sheet.refused}", "Find the rule again, or choose another policy.")
    return sheet


def _promise(numbers: dict[str, Any]) -> PromiseOut:
    return PromiseOut(**{name: numbers[name] for name in ("value", "low", "high")})


def _refusal(db: Session, participant: Participant, policy: Policy, rule: ThresholdRule, result: dict[str, Any]) -> str | None:
    """Say why nothing may be programmed: a serious event, an unsafe verdict, or limits that are others now."""
    try:
        refuse_after_events(db, participant, policy)
    except Conflict as event:
        return str(event.detail)
    if policy.retired_reason:
        return f"Policy '{policy.name}' is retired: {policy.retired_reason}."
    if result["verdict"]["code"] in ("unsafe", "likely_worse"):
        return f"By its own estimate the rule is {STANDING_NAMES[result['verdict']['code']]}."
    try:
        now = bounds_in_force(db, participant, Hemisphere(result["hemisphere"]) if result["hemisphere"] else None)
    except Invalid as unknown:
        return str(unknown.detail)
    if abs(now.cdbs_ma - result["cdbs_ma"]) > 1e-6:
        return f"The cDBS amplitude is {ma(now.cdbs_ma)} mA now, and the rule was found for {ma(result['cdbs_ma'])} mA."
    try:
        rule.require_within(now.min_ma, now.max_ma)
    except RuleError as error:
        return f"By {now.source}, {error}."
    return None


def _warnings(result: dict[str, Any], adaptive: bool, own_unit: bool) -> list[str]:
    told = []
    if not adaptive:
        told.append(
            f"The closest rule is a constant amplitude of {ma(result['rule']['upper_ma'])} mA: none within these limits follows the policy."
        )
    if not result["close"]:
        told.append(
            f"The rule is far from the policy: {ma(result['closeness']['rms_ma'])} mA apart (root mean square). In simulation the "
            "promises of such rules do not hold. Do not take it for the policy."
        )
    if not all(result["estimates"][name]["supported"] for name in ("rule", "policy")):
        told.append("The recorded sessions do not support the estimates: they are extrapolations.")
    if own_unit:
        told.append(
            f"Thresholds are in {result['beta']['unit']}, as session reports state LFP power, for the channel and centre of these "
            "sessions. The device's range is published in another unit, uVrms. Compare with the power on the programmer before you save."
        )
    else:
        told.append(
            f"Beta of these sessions is in {result['beta']['unit']} from {result['beta']['source']}, which is no power of this device. The "
            "thresholds must be set in clinic, from the device's own power."
        )
    told.append(
        f"These sessions measure {result['beta']['low_hz']:g} to {result['beta']['high_hz']:g} Hz every "
        f"{result['beta']['period_s']:g} s. The device senses 5 Hz around one centre between 8 and 30 Hz."
    )
    return told


# Settings in words, for the page and the print.


def setting_rows(rule: ThresholdRule, result: dict[str, Any], own_unit: bool) -> list[SettingOut]:
    """List the settings in the order in which a programmer asks for them."""
    (lower, upper), single = result["below_threshold"], rule.mode == "single"

    def threshold(value: float, share: float) -> tuple[str, str]:
        at = f"the level that power is not above for {100 * share:.0f} % of the time"
        return (f"{number(value, 4)} {result['beta']['unit']}: {at}" if own_unit else f"set in clinic: {at}"), ""

    def seconds(value: float) -> str:
        return f"{value / 60:g} min" if value >= 60 and value % 60 in (0, 30) else f"{value:g} s"

    onset = f"0 to {seconds(ONSET_S[rule.mode][1])}"
    ramp, current = f"{RAMP_S[0]:g} s to {seconds(RAMP_S[1])}", f"{LIMIT_MA[0]:g} to {LIMIT_MA[1]:g} mA"
    rows = [
        ("mode", "Threshold mode", "Single threshold" if single else "Dual threshold", "", "dual or single"),
        ("lower_ma", "Lower stimulation limit", f"{rule.lower_ma:.{1 if rule.step_ma >= 0.1 else 2}f}", "mA", current),
        ("upper_ma", "Upper stimulation limit", f"{rule.upper_ma:.{1 if rule.step_ma >= 0.1 else 2}f}", "mA", current),
        ("paused_ma", "Paused amplitude", ma(result["cdbs_ma"]), "mA", ""),
    ]
    if single:
        rows.append(
            (
                "upper_threshold",
                "LFP threshold",
                *threshold(rule.upper_threshold, upper),
                "0.55 to 400 uVrms (another unit)" if own_unit else "0.55 to 400 uVrms",
            )
        )
    else:
        rows.append(
            (
                "lower_threshold",
                "Lower LFP threshold",
                *threshold(rule.lower_threshold, lower),
                "0.55 to 400 uVrms (another unit)" if own_unit else "0.55 to 400 uVrms",
            )
        )
        rows.append(
            (
                "upper_threshold",
                "Upper LFP threshold",
                *threshold(rule.upper_threshold, upper),
                "0.55 to 400 uVrms (another unit)" if own_unit else "0.55 to 400 uVrms",
            )
        )
    rows += [
        ("onset_s", "Upper threshold onset", seconds(rule.onset_s), "", onset),
        ("termination_s", "Lower threshold onset (termination)", seconds(rule.termination_s), "", onset),
        ("ramp_up_s", "Transition up, lower to upper limit", seconds(rule.ramp_up_s), "", ramp),
        (
            "ramp_down_s",
            "Transition down, upper to lower limit",
            seconds(rule.ramp_down_s),
            "",
            ramp,
        ),
        ("averaging_s", "Averaging duration", seconds(rule.averaging_s), "", f"{AVERAGING_S[0]:g} to {AVERAGING_S[1]:g} s"),
        ("blanking_s", "Detection blanking", f"{seconds(rule.blanking_s)} (default)", "", ""),
    ]
    return [SettingOut(name=n, label=label, value=value, unit=unit, device_takes=takes) for n, label, value, unit, takes in rows]


def promise_rows(sheet: RuleSheetOut) -> list[tuple[str, str, str]]:
    """List what the sheet promises: what, the number, and what it rests on."""

    def interval(p: PromiseOut, sign: str = "+") -> str:
        return f"{p.value:{sign}.1f} ({p.low:{sign}.1f} to {p.high:{sign}.1f})"

    over = f"over {sheet.steps} recorded steps of {sheet.sessions} sessions"
    return [
        ("Return, less that of the policy", interval(sheet.to_policy), "90 % interval"),
        ("Return, less that of cDBS", interval(sheet.to_cdbs), "90 % interval"),
        ("Return of the rule itself", interval(sheet.return_rule, "-"), "depends on the day; judge by the differences above"),
        ("Amplitude, difference from the policy", f"{ma(sheet.difference_rms_ma)} mA", f"root mean square, {over}"),
        ("Amplitude, rule less policy", f"{sheet.difference_mean_ma:+.2f} mA", f"mean, {over}"),
        ("Energy of the rule", f"{100 * sheet.energy_rule:.0f} % of cDBS", f"policy {100 * sheet.energy_policy:.0f} %, {over}"),
    ]


def pdf_response(db: Session, participant: Participant, policy: Policy, caller: Caller) -> Response:
    """Return the sheet as a PDF, and record who took it. Raises as `printable`."""
    sheet = printable(db, participant, policy, caller)
    record(db, "download", "policy", policy.id, {"threshold_rule": sheet.job_id})
    name = f"{participant.code}-policy-{policy.id}-threshold-rule.pdf"
    headers = {"Content-Disposition": f'inline; filename="{name}"'}
    return Response(render_pdf(sheet, caller.label, now()), media_type="application/pdf", headers=headers)


def render_pdf(sheet: RuleSheetOut, printed_by: str, printed_at: datetime) -> bytes:
    """Render the sheet on one A4 page."""
    from fpdf import FPDF  # loaded for this sheet alone

    pdf = FPDF("portrait", "mm", "A4")
    pdf.set_margins(14, 12, 14)
    pdf.set_auto_page_break(True, 12)
    pdf.set_draw_color(*LINE)
    pdf.set_creation_date(printed_at)
    pdf.set_title(f"Threshold rule {sheet.participant}, policy {sheet.policy_id}")
    pdf.add_page()

    def write(text: str, size: float, style: str = "", colour: tuple[int, int, int] = INK) -> None:
        pdf.set_font("Helvetica", style, size)
        pdf.set_text_color(*colour)
        pdf.multi_cell(0, size * 0.46, _spell(text), align="L", new_x="LMARGIN", new_y="NEXT")

    side = f"{sheet.hemisphere} hemisphere" if sheet.hemisphere else "side not stated: ____________"
    write(f"{sheet.participant}: threshold rule for the programmer", 16, "B")
    write(f"Closest to policy {sheet.policy_name} ({sheet.policy_id}). {side}. cDBS {ma(sheet.cdbs_ma)} mA.", 9.5, colour=MUTED)
    write("\nSettings", 11, "B")
    widths = (62.0, 84.0, 36.0)
    for row in sheet.settings:
        _line(pdf, widths, (row.label, f"{row.value} {row.unit}".strip(), f"device: {row.device_takes}" if row.device_takes else ""))
    write(f"\nLimits of this participant: {ma(sheet.min_ma)} to {ma(sheet.max_ma)} mA, never above cDBS.", 9.5)
    write("\nPromise, simulated on the participant's own sessions", 11, "B")
    for what, value, about in promise_rows(sheet):
        _line(pdf, (62.0, 46.0, 74.0), (what, value, about))
    write("\nBefore it is used", 11, "B")
    for text in sheet.warnings:
        write(f"- {text}", 9.5)
    write("\n\nTyped into the programmer by, date ____________________     Checked against this sheet by, date ____________________", 9)
    for text in SOURCES:
        write(text, 7.5, colour=MUTED)
    about = f"betaloop, job {sheet.job_id}, snapshot {sheet.snapshot_id}, {sheet.made_at:%Y-%m-%d %H:%M} UTC"
    write(f"{about}. Printed {printed_at:%Y-%m-%d %H:%M} UTC by {printed_by}. For research: no medical device.", 7.5, colour=MUTED)
    return bytes(pdf.output())


def _spell(text: str) -> str:
    """Replace letters that the built-in fonts lack by a question mark."""
    return text.encode("latin-1", "replace").decode("latin-1")


def _line(pdf: Any, widths: tuple[float, float, float], texts: tuple[str, str, str]) -> None:
    """Write one row, as high as its longest text needs."""
    top = pdf.get_y()
    bottom = top
    for k, (width, text) in enumerate(zip(widths, texts, strict=True)):
        pdf.set_xy(pdf.l_margin + sum(widths[:k]), top + 0.8)
        pdf.set_font("Helvetica", "B" if k == 1 else "", 9.5 if k < 2 else 8)
        pdf.set_text_color(*(INK if k else MUTED))
        pdf.multi_cell(width, 4.4, _spell(text), align="L")
        bottom = max(bottom, pdf.get_y())
    pdf.line(pdf.l_margin, bottom + 0.6, pdf.l_margin + sum(widths), bottom + 0.6)
    pdf.set_xy(pdf.l_margin, bottom + 0.8)
