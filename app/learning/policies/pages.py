"""HTML pages of learning: policies, one policy, one snapshot."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any

from fastapi import APIRouter, File, Form, Request, UploadFile
from fastapi.responses import HTMLResponse, RedirectResponse, Response
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.learning import repository
from app.learning.deps import CurrentPolicy, CurrentSnapshot
from app.learning.models import Policy
from app.learning.policies import service
from app.learning.policies.uploads import read_limited
from app.learning.schemas import ALGORITHM_NAMES, PolicyChange, PolicyLabel
from app.learning.snapshots.coverage import describe
from app.learning.sweeps.comparison import below_bound
from app.platform.database import Db
from app.platform.errors import BetaloopError, Invalid, NotFound
from app.platform.web.charts import ACCENT, Chart, axis, figure
from app.platform.web.forms import FormValues, parse
from app.platform.web.schemas import PagingQuery
from app.platform.web.templates import render
from app.study import repository as study_repository
from app.study.deps import CurrentParticipant
from app.study.models import Participant
from app.study.service import may
from ml.rl.support import LARGEST_SHARE_BELOW

router = APIRouter()

LABELS = {"name": "Name", "retired_reason": "Reason"}

CURVES = {
    "mean_q": ("Mean Q of the policy", "reward; an unbounded climb is over-estimation"),
    "action_distance": ("Distance from the logged amplitudes", "mean absolute difference, fraction"),
    "saturated": ("States answered with next to 0 or 1", "share; at 1 the policy is cDBS or no DBS by another name"),
    "critic_loss": ("Critic loss", "mean squared temporal-difference error, reward squared"),
    "loss": ("Distillation loss", "mean squared difference from the teacher, fraction squared"),
}
"""Learning curves by the name that the learners give them: title and unit."""


@router.get("/participants/{code}/policies")
def policies_page(request: Request, participant: CurrentParticipant, db: Db, caller: CurrentCaller, paging: PagingQuery) -> HTMLResponse:
    """All policies of a participant, and the form for one made elsewhere."""
    return _policies(request, participant, db, caller, paging.limit, paging.offset)


@router.post("/participants/{code}/policies")
def add_policy(
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
            raise Invalid("No file was chosen.", "Choose an ONNX file.")
        label = parse(PolicyLabel, {"name": name}, LABELS).name
        row = service.add_external(db, participant, label, read_limited(file), file.filename, caller)
        db.commit()
    except BetaloopError as error:
        db.rollback()
        return _policies(request, participant, db, caller, 50, 0, error.problem(request.url.path), name, error.status)
    return RedirectResponse(f"/participants/{participant.code}/policies/{row.id}?done=added", 303)


@router.get("/participants/{code}/policies/{policy_id}")
def policy_page(request: Request, participant: CurrentParticipant, policy: CurrentPolicy, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """One policy: where it comes from, its learning curves, its bundle."""
    _belongs(policy, participant)
    related = {p.id: p for p in (db.get(Policy, i) for i in (policy.teacher_id, policy.parent_id) if i) if p}
    version = study_repository.settings_version(db, policy.settings_version_id)
    page = render(
        request,
        "learning/policy.html",
        participant=participant,
        policy=policy,
        teacher=related.get(policy.teacher_id or 0),
        parent=related.get(policy.parent_id or 0),
        settings=version,
        below=below if (below := below_bound(policy)) and below[1] > LARGEST_SHARE_BELOW else None,
        curves=curve_charts(policy.metrics.get("curve", {}), f"policy {policy.name}"),
        config={k: v for k, v in policy.config.items() if not k.endswith("_every")},
        may_write=may(caller, can.WRITE_POLICIES, participant),
    )
    return HTMLResponse(page)


@router.post("/participants/{code}/policies/{policy_id}/retire")
def retire_policy(participant: CurrentParticipant, policy: CurrentPolicy, db: Db, caller: CurrentCaller, values: FormValues) -> Response:
    """Retire a policy with a reason, or take it back."""
    _belongs(policy, participant)
    reason = parse(PolicyChange, {"retired_reason": values.get("reason", "")}, LABELS).retired_reason
    service.retire(db, participant, policy, reason, caller)
    db.commit()
    return RedirectResponse(f"/participants/{participant.code}/policies/{policy.id}?done={'retired' if reason else 'back'}", 303)


@router.get("/snapshots/{snapshot_id}")
def snapshot_page(request: Request, snapshot: CurrentSnapshot, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """What a snapshot's buffer covers."""
    participant = db.get_one(Participant, snapshot.participant_id)
    return HTMLResponse(render(request, "learning/snapshot.html", participant=participant, view=describe(db, snapshot, caller)))


def curve_charts(curve: Mapping[str, Sequence[float]], of: str) -> list[Chart]:
    """A chart for each learning curve of a policy."""
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
                subtitle=f"{unit} · {of} · n = {len(values)} points",
                figure=figure(data, xaxis=axis("Update"), yaxis=axis("", type="log" if log else "linear")),
                columns=["Update", title],
                rows=[[int(u), float(v)] for u, v in zip(updates, values, strict=True)],
                height=240,
            )
        )
    return charts


def _policies(
    request: Request,
    participant: Participant,
    db: Session,
    caller: Caller,
    limit: int,
    offset: int,
    problem: dict[str, Any] | None = None,
    name: str = "",
    status: int = 200,
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
        problem=problem,
        name=name,
        window=participant.current_settings.window,
        may_write=may(caller, can.WRITE_POLICIES, participant),
    )
    return HTMLResponse(page, status)


def _belongs(policy: Policy, participant: Participant) -> None:
    if policy.participant_id != participant.id:
        raise NotFound(f"Participant {participant.code} has no policy {policy.id}.")
