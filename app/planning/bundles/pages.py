"""The page of a policy's controller bundle: what it would hold and say, and the form to take it."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from typing import Annotated, Any

from fastapi import APIRouter, File, Form, Request, UploadFile
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from pydantic import BaseModel, ConfigDict, Field
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.learning.deps import CurrentOwnPolicy
from app.pipeline import service as jobs
from app.pipeline.params import THRESHOLD_RULE, ThresholdRuleParams
from app.planning import releases
from app.planning.bundles import ports, release, repository, slots
from app.planning.bundles import service as bundles
from app.planning.bundles import threshold_rule as rules
from app.planning.plans import wording
from app.planning.plans.limits import device_limits
from app.planning.plans.sign_off import common_limits
from app.planning.plans.view import read_plan
from app.platform import numbers
from app.platform.database import Db
from app.platform.errors import BetaloopError, Conflict, Invalid, NotFound
from app.platform.web.forms import FormValues, field_notes, parse
from app.platform.web.templates import render
from app.settings import get_settings
from app.study.access import may
from app.study.deps import CurrentParticipant, CurrentVisit, ResultsViewed
from app.tables.jobs import JobStatus
from app.tables.learning import Policy
from app.tables.participants import Hemisphere, Participant
from ml.deploy.ports.answers import MAX_BYTES
from ml.deploy.wording import battery_life_words, energy_words, warning_sentences

router = APIRouter()

LABELS = {"min_ma": "Lowest amplitude", "max_ma": "Highest amplitude", "ramp_ma_per_s": "Fastest change", "hemisphere": "Hemisphere"}


class StatedLimits(BaseModel):
    """The form: the clinician's limits, mA and mA/s."""

    model_config = ConfigDict(extra="forbid")

    min_ma: float = Field(ge=0, le=25.5, allow_inf_nan=False)
    max_ma: float = Field(ge=0, le=25.5, allow_inf_nan=False)
    ramp_ma_per_s: float = Field(gt=0, le=100, allow_inf_nan=False)
    hemisphere: Hemisphere | None = None


@router.get("/participants/{code}/policies/{policy_id}/bundle", dependencies=[ResultsViewed])
def bundle_page(request: Request, participant: CurrentParticipant, policy: CurrentOwnPolicy, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show what the bundle would contain under the default limits."""
    return _page(request, participant, policy, db, caller)


@router.post("/participants/{code}/policies/{policy_id}/bundle")
def take_bundle(
    request: Request, participant: CurrentParticipant, policy: CurrentOwnPolicy, db: Db, caller: CurrentCaller, values: FormValues
) -> Response:
    """Download the signed ZIP under the limits of the form; the page again, with what was typed, where they cannot be used."""
    typed = {name: str(values.get(name, "")) for name in LABELS}
    try:
        limits, hemisphere = _stated(typed)
        content = bundles.bundle(db, participant, policy, limits, hemisphere, caller)
    except BetaloopError as error:
        db.rollback()
        return _page(request, participant, policy, db, caller, error, typed)
    name = f"{participant.code}-policy-{policy.id}.zip"
    return Response(content, media_type="application/zip", headers={"Content-Disposition": f'attachment; filename="{name}"'})


@router.post("/participants/{code}/policies/{policy_id}/ports")
def check_port(
    request: Request,
    participant: CurrentParticipant,
    policy: CurrentOwnPolicy,
    db: Db,
    caller: CurrentCaller,
    target: Annotated[str, Form(max_length=100)] = "",
    file: Annotated[UploadFile | None, File()] = None,
) -> Response:
    """Check a converted copy by the table of its answers."""
    try:
        if file is None or not file.filename:
            raise Invalid("No file was chosen.", "Choose the CSV with the answers of the copy.", field="file")
        ports.add_check(db, participant, policy, file.file.read(MAX_BYTES + 1), target, None, caller)
    except BetaloopError as error:
        db.rollback()
        return _page(request, participant, policy, db, caller, error, {"target": target}, form="port")
    return RedirectResponse(f"/participants/{participant.code}/policies/{policy.id}/bundle?done=checked#ports", 303)


@router.post("/participants/{code}/policies/{policy_id}/release")
def release_policy(
    request: Request, participant: CurrentParticipant, policy: CurrentOwnPolicy, db: Db, caller: CurrentCaller, values: FormValues
) -> Response:
    """Sign the policy as released for testing in participants, within the limits of the form."""
    typed = {name: str(values.get(name, "")) for name in LABELS}
    try:
        limits, hemisphere = _stated(typed)
        password, code = str(values.get("password", "")), str(values.get("code", ""))
        release.release(db, participant, policy, limits, hemisphere, caller, password, code)
    except BetaloopError as error:
        db.rollback()
        return _page(request, participant, policy, db, caller, error, typed, form="release")
    return RedirectResponse(f"/participants/{participant.code}/policies/{policy.id}/bundle?done=released#release", 303)


@router.get("/visits/{visit_id}/bundles")
def session_bundles(request: Request, visit: CurrentVisit, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show the bundles of a signed plan, one per session, and how to bring them to the tablet."""
    view = read_plan(db, visit, caller)
    problem = None
    try:
        slots.runnable(view)
    except BetaloopError as error:
        problem = error.problem(request.url.path)
    page = render(
        request,
        "planning/session_bundles.html",
        participant=visit.participant,
        visit=visit,
        view=view,
        limits_ma=wording.limits_ma,
        common=common_limits(view.plan.items) if view.sealed else None,  # the limits of one session reveal what it runs
        problem=problem,
        taken=Counter(r.plan_item_id for r in repository.releases_of_slots(db, [line.item.id for line in view.lines])),
        may_take=bundles.may_take(visit.participant, caller),
        key=bundles.public_key(),
    )
    return HTMLResponse(page)


def _stated(typed: Mapping[str, str]) -> tuple[bundles.Limits, Hemisphere | None]:
    """Parse the limits and the side of a form. Raises Invalid, naming the field."""
    stated = parse(StatedLimits, typed, LABELS)
    return bundles.Limits(stated.min_ma, stated.max_ma, stated.ramp_ma_per_s), stated.hemisphere


def _page(
    request: Request,
    participant: Participant,
    policy: Policy,
    db: Session,
    caller: Caller,
    error: BetaloopError | None = None,
    typed: Mapping[str, str] | None = None,
    *,
    form: str = "",
) -> HTMLResponse:
    facts: dict[str, Any] = {"manifest": None, "warnings": [], "energy": None, "unmade": None, "stopped": None}
    if error is None:
        try:
            bundles.refuse_after_events(db, participant, policy)
        except Conflict as stopped:
            facts["stopped"] = stopped.problem(request.url.path)
    sides = sorted({Hemisphere(a.hemisphere) for visit in participant.visits for a in visit.cdbs_amplitudes})
    try:
        wished = (typed or {}).get("hemisphere")
        side = next((side for side in sides if side == wished), sides[0] if sides else None)
        m = bundles.preview(db, participant, policy, bundles.Limits(), side, caller)
        energy = None
        if m.energy_of_cdbs is not None and m.charge_of_cdbs is not None:
            energy = [energy_words(m.energy_of_cdbs), battery_life_words(m.energy_of_cdbs, m.charge_of_cdbs)]
        # so many digits that a release signed as shown allows a plan with the same defaults (`releases.service.TOLERANCE`)
        shown = {name: numbers.typed(getattr(m, name), 9) for name in ("min_ma", "max_ma", "ramp_ma_per_s")} | {
            "hemisphere": m.hemisphere or ""
        }
        facts |= {"manifest": m, "warnings": warning_sentences(m), "energy": energy, "shown": shown}
    except Invalid as reason:
        facts["unmade"] = reason.problem(request.url.path)
    page = render(
        request,
        "planning/bundle.html",
        participant=participant,
        policy=policy,
        typed=typed,
        sides=sides,
        device=device_limits(db, participant, None),
        releases=repository.releases(db, policy.id),
        may_take=bundles.may_take(participant, caller),
        release=releases.release_of(db, participant, policy),
        release_meaning=releases.MEANING,
        brought=releases.brought_by(db, policy, caller),
        release_required=get_settings().require_released_policies,
        may_release=may(caller, can.RELEASE, participant),
        key=bundles.public_key(),
        remarks=field_notes(error, typed or {}),
        releasing=form == "release",
        porting=form == "port",
        ports=[(row, ports.line_of(row), check) for row, check in ports.checks_of(db, policy)],
        problem=error.problem(request.url.path) if error else None,
        **facts,
    )
    return HTMLResponse(page, error.status if error else 200)


# The threshold rule that comes closest to a policy: another way for it to leave.

RULE_LABELS = {
    "min_ma": "Lowest amplitude", "max_ma": "Highest amplitude", "hemisphere": "Hemisphere", "device": "Device", "preset": "Size",
}  # fmt: skip


@router.get("/participants/{code}/policies/{policy_id}/threshold-rule", dependencies=[ResultsViewed])
def threshold_rule_page(
    request: Request, participant: CurrentParticipant, policy: CurrentOwnPolicy, db: Db, caller: CurrentCaller
) -> HTMLResponse:
    """Show the newest rule of a policy, and the form to find it."""
    return _rule_page(request, participant, policy, db, caller)


@router.post("/participants/{code}/policies/{policy_id}/threshold-rule")
def find_threshold_rule(
    request: Request, participant: CurrentParticipant, policy: CurrentOwnPolicy, db: Db, caller: CurrentCaller, values: FormValues
) -> Response:
    """Start the job that finds the rule."""
    given: dict[str, Any] = {name: str(values.get(name, "")) for name in RULE_LABELS if str(values.get(name, "")).strip()}
    try:
        asked = parse(ThresholdRuleParams, given | {"policy_id": str(policy.id)}, RULE_LABELS)
        within = rules.bounds_in_force(db, participant, asked.hemisphere)
        if asked.min_ma < within.min_ma - 1e-6:
            raise Invalid(
                f"A lowest amplitude of {asked.min_ma:g} mA is below {within.min_ma:g} mA, the least by {within.source}.", "Raise it.",
                field="min_ma",
            )  # fmt: skip
        started = jobs.start_job(db, participant, THRESHOLD_RULE, asked.model_dump(mode="json"), caller)
    except BetaloopError as error:
        db.rollback()
        return _rule_page(request, participant, policy, db, caller, error, given)
    return RedirectResponse(f"/jobs/{started.job.id}?done={'started' if started.new else 'same'}", 303)


@router.get("/participants/{code}/policies/{policy_id}/threshold-rule.pdf", dependencies=[ResultsViewed])
def print_threshold_rule(participant: CurrentParticipant, policy: CurrentOwnPolicy, db: Db, caller: CurrentCaller) -> Response:
    """Return the sheet as one A4 page."""
    return rules.pdf_response(db, participant, policy, caller)


def _rule_page(
    request: Request,
    participant: Participant,
    policy: Policy,
    db: Session,
    caller: Caller,
    error: BetaloopError | None = None,
    entries: dict[str, Any] | None = None,
) -> HTMLResponse:
    sides = sorted({Hemisphere(a.hemisphere) for visit in participant.visits for a in visit.cdbs_amplitudes})
    wished = (entries or {}).get("hemisphere")
    side = next((s for s in sides if s == wished), sides[0] if sides else None)
    try:
        bounds, unmade = rules.bounds_in_force(db, participant, side), None
    except Invalid as reason:
        bounds, unmade = None, reason.problem(request.url.path)
    try:
        sheet = rules.rule_sheet(db, participant, policy)
    except NotFound:
        sheet = None
    newest = rules.newest_job(db, participant, policy)
    shown = {"device": "percept_pc", "preset": "full", "hemisphere": side or "", "min_ma": "", "max_ma": ""}
    if bounds:
        shown |= {"min_ma": numbers.typed(bounds.min_ma, 6), "max_ma": numbers.typed(bounds.max_ma, 6)}
    page = render(
        request,
        "planning/threshold_rule.html",
        participant=participant,
        policy=policy,
        sheet=sheet,
        promises=rules.promise_rows(sheet) if sheet else [],
        sources=rules.SOURCES,
        bounds=bounds,
        unmade=unmade,
        at_work=newest if newest is not None and not JobStatus(newest.status).ended else None,
        sides=sides,
        shown=shown | (entries or {}),
        remarks=field_notes(error, entries or {}),
        may_run=may(caller, can.RUN_JOBS, participant),
        may_print=may(caller, can.TAKE_BUNDLES, participant),
        problem=error.problem(request.url.path) if error else None,
    )
    return HTMLResponse(page, error.status if error else 200)
