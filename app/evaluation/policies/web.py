"""HTML page of one policy."""

from __future__ import annotations

from fastapi import APIRouter, Request, Response
from fastapi.responses import HTMLResponse, RedirectResponse
from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.deps import CurrentCaller
from app.accounts.permissions import Caller
from app.evaluation.policies.replay import other_than
from app.evaluation.ranking import verdict_wording
from app.evaluation.ranking.answer import Answer
from app.evaluation.ranking.service import current
from app.evaluation.repository import PolicyHead
from app.learning import repository as learning
from app.learning.deps import CurrentOwnPolicy
from app.learning.policies import retire
from app.learning.policies_web import curve_charts
from app.learning.schemas import ALGORITHM_NAMES, PolicyChange
from app.learning.sweeps import below_bound
from app.platform.database import Db
from app.platform.errors import BetaloopError, Invalid, NotFound
from app.platform.web.forms import FormValues, field_notes, parse
from app.platform.web.templates import Part, make_part, render
from app.study import repository as study_repository
from app.study.access import may, require
from app.study.deps import CurrentParticipant, ResultsViewed
from app.tables.learning import Policy
from app.tables.participants import Participant
from ml.policies.logged_range import LARGEST_SHARE_BELOW

pages = APIRouter()

_LABELS = {"retired_reason": "Reason"}


@pages.get("/participants/{code}/policies/{policy_id}", dependencies=[ResultsViewed])
def policy_page(request: Request, participant: CurrentParticipant, policy: CurrentOwnPolicy, db: Db, caller: CurrentCaller) -> HTMLResponse:
    """Show one policy: its verdict and picture, where it comes from, its learning curves, its bundle."""
    return _page(request, participant, policy, db, caller)


@pages.post("/participants/{code}/policies/{policy_id}/retire")
def retire_policy(
    request: Request, participant: CurrentParticipant, policy: CurrentOwnPolicy, db: Db, caller: CurrentCaller, values: FormValues
) -> Response:
    """Retire a policy with a reason, or take it back into use."""
    back, reason = values.get("back") == "yes", str(values.get("reason", ""))
    try:
        require(caller, can.WRITE_POLICIES, participant)
        if not back and not reason.strip():
            raise Invalid("A policy is retired with a reason.", "Say why it is no longer ranked or planned.", field="reason")
        change = parse(PolicyChange, {"retired_reason": "" if back else reason}, _LABELS, {"retired_reason": "reason"})
        retire(db, participant, policy, change.retired_reason, caller)
    except BetaloopError as error:
        db.rollback()
        return _page(request, participant, policy, db, caller, error, reason)
    return RedirectResponse(f"/participants/{participant.code}/policies/{policy.id}?done={'back' if back else 'retired'}", 303)


def _page(
    request: Request,
    participant: Participant,
    policy: Policy,
    db: Session,
    caller: Caller,
    error: BetaloopError | None = None,
    reason: str = "",
) -> HTMLResponse:
    """Render the page; `reason` is that of the form which was refused."""
    try:
        judged = current(db, participant, caller)
    except NotFound:
        judged = None
    row = judged.answer.everyone().get(policy.id) if judged else None
    below = below_bound(policy)
    answered = judged.answer if judged else None
    page = render(
        request,
        "learning/policy.html",
        participant=participant,
        policy=policy,
        lineage=_lineage(db, policy),
        settings=study_repository.settings_version(db, policy.settings_version_id),
        below=below if below and below[1] > LARGEST_SHARE_BELOW else None,
        curves=curve_charts(policy.metrics.get("curve", {}), f"policy {policy.name}"),
        config={k: v for k, v in policy.config.items() if not k.endswith("_every")},
        row=row,
        standing=make_part(Part.STANDINGS, db, participant, caller).get(policy.id, ""),
        picture=judged.picture(participant.current_settings.bound, policy.id) if judged and row else None,
        other=other_than(policy, learning.candidates(db, participant.id), answered),
        same=_same(policy, answered) if answered else [],
        plainly=verdict_wording.plainly,
        effect=verdict_wording.effect,
        dose_words=verdict_wording.dose_words,
        cdbs_ma=answered.cdbs_ma if answered else None,
        test_results=verdict_wording.test_results,
        standing_names=verdict_wording.STANDING_NAMES,
        may_write=may(caller, can.WRITE_POLICIES, participant),
        algorithm_names=ALGORITHM_NAMES,
        reason=reason,
        remarks=field_notes(error, {"reason": reason}),
        problem=error.problem(request.url.path) if error else None,
    )
    return HTMLResponse(page, error.status if error else 200)


def _same(policy: Policy, answered: Answer) -> list[PolicyHead]:
    """List the other policies of its row in the ranking."""
    heads = answered.heads()
    return [row.one.policy for i, row in answered.everyone().items() if i != policy.id and heads[i] == heads.get(policy.id)]


def _lineage(db: Session, policy: Policy) -> list[tuple[str, Policy]]:
    """List what a policy was made from, the nearest first: how, and from which one."""
    found: list[tuple[str, Policy]] = []
    seen = {policy.id}
    at: Policy | None = policy
    while at is not None:
        how, before = ("distilled from", at.teacher_id) if at.teacher_id is not None else ("fine-tuned from", at.parent_id)
        at = db.get(Policy, before) if before is not None and before not in seen else None
        if at is not None:
            seen.add(at.id)
            found.append((how, at))
    return found
