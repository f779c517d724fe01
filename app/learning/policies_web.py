"""HTML pages of learning: policies, one snapshot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated

from fastapi import APIRouter, File, Form, Request, Response, UploadFile
from fastapi.responses import HTMLResponse, RedirectResponse
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.learning import policies, repository
from app.learning.coverage import describe
from app.learning.deps import CurrentPolicy, CurrentSnapshot
from app.learning.policies import read_limited
from app.learning.schemas import ALGORITHM_NAMES, PolicyChange, PolicyLabel, PolicyName, PolicyOut
from app.platform.database import Db
from app.platform.errors import BetaloopError, Invalid
from app.platform.numbers import counted
from app.platform.web.charts import ACCENT, Chart, axis, figure
from app.platform.web.forms import field_notes, parse
from app.platform.web.schemas import Page, PagingQuery, problems
from app.platform.web.templates import render
from app.study import repository as study_repository
from app.study.access import may
from app.study.deps import CurrentParticipant
from app.tables.learning import Policy
from app.tables.participants import Participant

# Learning curves of one policy, as charts.

CURVES = {
    "mean_q": ("Promised return of the policy", "reward; an unbounded climb is over-estimation"),
    "action_distance": ("Distance from the recorded amplitudes", "mean absolute difference, fraction of cDBS"),
    "saturated": ("States answered with next to 0 or 1", "share; at 1 the policy is cDBS or no DBS by another name"),
    "critic_loss": ("Critic loss", "mean squared temporal-difference error, reward squared"),
    "loss": ("Distillation loss", "mean squared difference from the teacher, fraction squared"),
}
"""Learning curves by the name that the learners give them: title and unit."""


def curve_charts(curve: Mapping[str, Sequence[float]], of: str) -> list[Chart]:
    """Make a chart for each learning curve of a policy."""
    updates = curve.get("update", [])
    charts = []
    for name, (title, unit) in CURVES.items():
        values = curve.get(name)
        if not values:
            continue
        data = [{"type": "scatter", "mode": "lines", "x": updates, "y": values, "line": {"color": ACCENT, "width": 2}}]
        log = "loss" in name and min(values) > 0
        charts.append(
            Chart(
                id=f"curve-{name}",
                title=title,
                subtitle=f"{unit} · {of} · n = {counted(len(values), 'point')}",
                figure=figure(data, xaxis=axis("Update"), yaxis=axis("", type="log" if log else "linear")),
                columns=["Update", title],
                rows=[[int(u), float(v)] for u, v in zip(updates, values, strict=True)],
                height=240,
            )
        )
    return charts


# REST routes of policies.

api = APIRouter(tags=["learning"], responses=problems(401, 403, 404, 422))


def policy_out(db: Session, p: Policy, participant: Participant) -> PolicyOut:
    """Convert a policy for the API."""
    return PolicyOut(
        id=p.id,
        participant=participant.code,
        name=p.name,
        kind=p.kind,
        algorithm=p.algorithm,
        teacher_id=p.teacher_id,
        parent_id=p.parent_id,
        snapshot_id=p.snapshot_id,
        settings_version=study_repository.settings_version(db, p.settings_version_id).version,
        job_id=p.job_id,
        config=p.config,
        seed=p.seed,
        metrics=p.metrics,
        onnx_sha256=p.onnx_sha256,
        code_version=p.code_version,
        created_at=p.created_at,
        created_by=p.created_by,
        retired_reason=p.retired_reason,
    )


@api.get("/participants/{code}/policies")
def list_policies(participant: CurrentParticipant, db: Db, paging: PagingQuery) -> Page[PolicyOut]:
    """List policies of a participant, newest first; baselines and retired ones among them."""
    rows, total = repository.policies(db, participant.id, paging.limit, paging.offset)
    return Page(items=[policy_out(db, p, participant) for p in rows], total=total, limit=paging.limit, offset=paging.offset)


@api.post("/participants/{code}/policies", status_code=201, responses=problems(409, 413, 429))
def add_policy(
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    name: Annotated[PolicyName, Form(description="How the study calls it.")],
    file: Annotated[
        UploadFile, File(description="ONNX: input [N, W] of beta windows, oldest first; output [N, 1] of amplitude fractions.")
    ],
) -> PolicyOut:
    """Add a policy made elsewhere; it is checked by running it."""
    row = policies.add_external(db, participant, name.strip(), read_limited(file), file.filename or "policy.onnx", caller)
    return policy_out(db, row, participant)


@api.get("/policies/{policy_id}")
def read_policy(policy: CurrentPolicy, db: Db) -> PolicyOut:
    """Return one policy."""
    return policy_out(db, policy, db.get_one(Participant, policy.participant_id))


@api.patch("/policies/{policy_id}")
def change_policy(policy: CurrentPolicy, change: PolicyChange, db: Db, caller: CurrentCaller) -> PolicyOut:
    """Retire a policy with a reason, or take it back."""
    participant = db.get_one(Participant, policy.participant_id)
    policies.retire(db, participant, policy, change.retired_reason, caller)
    return policy_out(db, policy, participant)


pages = APIRouter()

LABELS = {"name": "Name"}


@pages.get("/participants/{code}/policies")
def policies_page(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, paging: PagingQuery) -> HTMLResponse:
    """Show all policies of a participant, and the form for one made elsewhere."""
    return _policies(request, participant, db, caller, paging.limit, paging.offset)


@pages.post("/participants/{code}/policies")
def add_policy_by_form(
    request: Request,
    participant: CurrentParticipant,
    db: Db,
    caller: CurrentCaller,
    name: Annotated[str, Form(max_length=200)] = "",
    file: Annotated[UploadFile | None, File()] = None,
) -> Response:
    """Add a policy made elsewhere."""
    try:
        if file is None or not file.filename:
            raise Invalid("No file was chosen.", "Choose an ONNX file.", field="file")
        label = parse(PolicyLabel, {"name": name}, LABELS).name
        row = policies.add_external(db, participant, label, read_limited(file), file.filename, caller)
    except BetaloopError as error:
        db.rollback()
        return _policies(request, participant, db, caller, 50, 0, error, name)
    return RedirectResponse(f"/participants/{participant.code}/policies/{row.id}?done=added", 303)


@pages.get("/snapshots/{snapshot_id}")
def snapshot_page(request: Request, snapshot: CurrentSnapshot, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show what a snapshot's buffer covers."""
    participant = db.get_one(Participant, snapshot.participant_id)
    return HTMLResponse(render(request, "learning/snapshot.html", participant=participant, view=describe(db, snapshot, caller)))


def _policies(
    request: Request,
    participant: Participant,
    db: Session,
    caller: Caller,
    limit: int,
    offset: int,
    error: BetaloopError | None = None,
    name: str = "",
) -> HTMLResponse:
    rows, total = repository.policies(db, participant.id, limit, offset)
    snapshots, snapshot_count = repository.snapshots(db, participant.id, 5, 0)
    page = render(
        request,
        "learning/policies.html",
        participant=participant,
        policies=rows,
        total=total,
        limit=limit,
        offset=offset,
        snapshots=snapshots,
        snapshot_count=snapshot_count,
        sweeps=repository.sweeps(db, participant.id, 10, 0)[0],
        algorithm_names=ALGORITHM_NAMES,
        problem=error.problem(request.url.path) if error else None,
        remarks=field_notes(error, {"name": name}),
        name=name,
        window=participant.current_settings.window,
        may_write=may(caller, can.WRITE_POLICIES, participant),
    )
    return HTMLResponse(page, error.status if error else 200)
