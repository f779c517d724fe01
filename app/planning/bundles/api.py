"""REST routes of controller bundles, and of the printed sheet of a plan, which names them."""

from __future__ import annotations

from datetime import datetime
from typing import Annotated, Any

from fastapi import APIRouter, File, Form, Path, Query, Response, UploadFile
from fastapi.responses import HTMLResponse, PlainTextResponse
from pydantic import Field
from sqlalchemy.orm import Session

from app.accounts.deps import CurrentCaller
from app.learning.deps import CurrentOwnPolicy, CurrentPolicy
from app.planning.bundles import ports, slots
from app.planning.bundles import service as bundles
from app.planning.bundles import threshold_rule as rules
from app.planning.bundles.repository import releases_of_slots
from app.planning.plans.view import PlanView, read_plan, standings_of
from app.platform.audit import record
from app.platform.database import Db, now
from app.platform.web.schemas import Model, RowId, Text, problems
from app.study.deps import CurrentParticipant, CurrentVisit, ResultsViewed
from app.tables.participants import Hemisphere, Participant
from app.tables.plans import PortCheck
from ml.deploy.ports.answers import MAX_BYTES
from ml.deploy.ports.report import fault_words, page_pdf
from ml.deploy.ports.report import page as printed_check

router = APIRouter(tags=["learning"], responses=problems(401, 403, 404, 422))
of_plans = APIRouter(tags=["planning"], responses=problems(401, 403, 404, 422))

Milliamperes = Annotated[float | None, Query(ge=0, le=25.5, allow_inf_nan=False)]


@router.get(
    "/policies/{policy_id}/bundle",
    response_class=Response,
    responses=problems(409) | {200: {"content": {"application/zip": {}}, "description": "The controller bundle."}},
)
def read_bundle(
    policy: CurrentPolicy,
    db: Db,
    caller: CurrentCaller,
    min_ma: Annotated[Milliamperes, Query(description="Lowest amplitude, mA; the stimulator's own limit, or 0, where not given.")] = None,
    max_ma: Annotated[Milliamperes, Query(description="Highest amplitude, mA; the cDBS amplitude where not given.")] = None,
    ramp_ma_per_s: Annotated[float | None, Query(gt=0, le=100, allow_inf_nan=False, description="Fastest change, mA/s.")] = None,
    hemisphere: Annotated[Hemisphere | None, Query(description="Needed where a visit states several cDBS amplitudes.")] = None,
) -> Response:
    """Return the signed controller bundle as a ZIP: network, C header, reference runner, test vectors, the clinician's limits, a sheet.

    It is stored when it is first taken. Taken again, it has the same bytes, with the name of the first taker. The audit trail records each
    time who took it, for whom and within which limits.
    """
    participant = db.get_one(Participant, policy.participant_id)
    content = bundles.bundle(db, participant, policy, bundles.Limits(min_ma, max_ma, ramp_ma_per_s), hemisphere, caller)
    name = f"{participant.code}-policy-{policy.id}.zip"
    return Response(content, media_type="application/zip", headers={"Content-Disposition": f'attachment; filename="{name}"'})


class PortFaultOut(Model):
    """One fault of a converted copy."""

    code: str = Field(description="`lost_sample`, `full_dose`, `order`, `wrap`, `rounded` and others: docs/deployment.md.")
    text: str


class PortCheckOut(Model):
    """Check of a converted copy by its answers to the port vectors of a bundle."""

    id: int
    policy_id: int
    target: str = Field(description="What was converted, by what.")
    verdict: str = Field(description="`same`, `within` or `not this policy`.")
    headline: str
    worst_ma: float | None = Field(description="Largest difference, mA; null where nothing could be compared.")
    faults: list[PortFaultOut]
    bundle_sha256: str
    answers_sha256: str
    created_at: datetime
    created_by: str


@router.get("/policies/{policy_id}/port-checks")
def list_port_checks(policy: CurrentPolicy, db: Db) -> list[PortCheckOut]:
    """List the checks of converted copies of a policy, newest first."""
    return [_port_check_out(row) for row, _ in ports.checks_of(db, policy)]


@router.post("/policies/{policy_id}/port-checks", status_code=201, responses=problems(409, 413))
def add_port_check(
    policy: CurrentPolicy,
    db: Db,
    caller: CurrentCaller,
    file: Annotated[UploadFile, File(description="CSV: `row` and `hash` of port-vectors.csv, and `answer`, `answer_ma` or both.")],
    target: Annotated[Text, Form(max_length=100, description="What was converted, by what, as 'TFLite, onnx2tf 1.29.24'.")],
    bundle: Annotated[str | None, Form(pattern="^[0-9a-f]{64}$", description="SHA-256 of the bundle; the newest one if missing.")] = None,
) -> PortCheckOut:
    """Check a converted copy of a policy by its answers to the port vectors of a bundle that was taken."""
    participant = db.get_one(Participant, policy.participant_id)
    return _port_check_out(ports.add_check(db, participant, policy, file.file.read(MAX_BYTES + 1), target, bundle, caller))


@router.get(
    "/policies/{policy_id}/port-checks/{check_id}/page",
    response_class=HTMLResponse,
    responses={200: {"content": {"text/html": {}}, "description": "The page."}},
)
def print_port_check(policy: CurrentPolicy, check_id: RowId, db: Db) -> HTMLResponse:
    """Show one page about a check of a converted copy, for the study's file."""
    row = ports.find_check(db, policy, check_id)
    return HTMLResponse(printed_check(ports.result_of(row), row.target, f"{row.created_at:%d %B %Y}, {row.created_by}"))


@router.get(
    "/policies/{policy_id}/port-checks/{check_id}/page.pdf",
    response_class=Response,
    responses={200: {"content": {"application/pdf": {}}, "description": "The page as PDF."}},
)
def print_port_check_pdf(policy: CurrentPolicy, check_id: RowId, db: Db) -> Response:
    """Return one page about a check of a converted copy as PDF, for the study's file."""
    row = ports.find_check(db, policy, check_id)
    record(db, "download", "policy", policy.id)
    content = page_pdf(ports.result_of(row), row.target, f"{row.created_at:%d %B %Y}, {row.created_by}")
    return Response(content, media_type="application/pdf")


def _port_check_out(row: PortCheck) -> PortCheckOut:
    found = ports.result_of(row)
    return PortCheckOut(
        id=row.id,
        policy_id=row.policy_id,
        target=row.target,
        verdict=row.verdict,
        headline=ports.line_of(row),
        worst_ma=found.worst_ma,
        faults=[PortFaultOut(code=fault.code, text=fault_words(fault, found)) for fault in found.faults],
        bundle_sha256=row.bundle_sha256,
        answers_sha256=row.answers_sha256,
        created_at=row.created_at,
        created_by=row.created_by,
    )


@router.get(
    "/visits/{visit_id}/plan/sessions/{position}/bundle",
    response_class=Response,
    responses=problems(409) | {200: {"content": {"application/zip": {}}, "description": "The session's bundle."}},
)
def read_session_bundle(
    visit: CurrentVisit, db: Db, caller: CurrentCaller, position: Annotated[int, Path(ge=1, le=1000, description="Of the session.")]
) -> Response:
    """Return the signed bundle of one session of the visit's signed plan: it runs on the day of the visit, once.

    Sessions of policies contain the network, random and cDBS sessions their schedule. A plan that is not signed, was changed since, or has
    a withdrawn policy has none. Nor has one with a policy under which a serious event happened since, until a clinician clears it. The
    bundle is stored when it is first taken; later it is the same bytes, and the audit trail has each time.
    """
    name, content = slots.bundle(db, visit, position, caller)
    return Response(content, media_type="application/zip", headers={"Content-Disposition": f'attachment; filename="{name}"'})


@router.get("/bundle-withdrawals", response_class=PlainTextResponse)
def read_withdrawals(db: Db, caller: CurrentCaller) -> PlainTextResponse:
    """Return withdrawn policies and plans, signed: bring it to the tablet, which then refuses their bundles.

    Plans that may not run after a serious adverse event are among them, until a clinician has cleared it.
    """
    return PlainTextResponse(slots.withdrawals(db))


@router.get("/bundle-key", response_class=PlainTextResponse)
def read_bundle_key(caller: CurrentCaller) -> str:
    """Return the public key that this installation's bundles are signed with: 64 hexadecimal digits. Give it to a tablet once."""
    return bundles.public_key() + "\n"


_PDF: dict[int | str, dict[str, Any]] = {200: {"content": {"application/pdf": {}}, "description": "The sheet."}}


@of_plans.get("/visits/{visit_id}/plan.pdf", response_class=Response, responses=_PDF)
def print_plan(visit: CurrentVisit, db: Db, caller: CurrentCaller) -> Response:
    """Return the plan as a sheet to print: sessions in order, estimates, blanks, signatures. A draft is marked across every page."""
    view = read_plan(db, visit, caller)
    record(db, "download", "plan", view.plan.id)
    name = f"plan-{visit.participant.code}-visit-{visit.number}.pdf"
    from app.planning.sheet import pdf  # what writes PDF takes long to load: a service that was killed is back sooner without it

    copies = ports.lines_of(db, [line.policy.id for line in view.lines if line.policy is not None])
    content = pdf.render(view, _bundles(db, view), copies, caller.label, now(), standings_of(db, view, caller))
    return Response(content, media_type="application/pdf", headers={"Content-Disposition": f'inline; filename="{name}"'})


def _bundles(db: Session, view: PlanView) -> dict[int, str]:
    """Find the newest bundle that was taken for each session, by the number of its plan item."""
    newest_last = reversed(releases_of_slots(db, [line.item.id for line in view.lines]))
    return {row.plan_item_id: row.sha256 for row in newest_last if row.plan_item_id is not None}


# The threshold rule that comes closest to a policy: another way for it to leave.


@of_plans.get("/participants/{code}/policies/{policy_id}/threshold-rule", dependencies=[ResultsViewed])
def read_threshold_rule(participant: CurrentParticipant, policy: CurrentOwnPolicy, db: Db) -> rules.RuleSheetOut:
    """Return the settings of an implant that come closest to a policy, what is lost by them, and whether they may be programmed.

    A job of kind `threshold_rule` finds them: `POST /participants/{code}/jobs`.
    """
    return rules.rule_sheet(db, participant, policy)


@of_plans.get(
    "/participants/{code}/policies/{policy_id}/threshold-rule/sheet",
    dependencies=[ResultsViewed],
    response_class=Response,
    responses=problems(409) | {200: {"content": {"application/pdf": {}}, "description": "One A4 page."}},
)
def read_threshold_rule_sheet(participant: CurrentParticipant, policy: CurrentOwnPolicy, db: Db, caller: CurrentCaller) -> Response:
    """Return the same as one A4 page, to be typed into the programmer. None leaves that may not be programmed now."""
    return rules.pdf_response(db, participant, policy, caller)
