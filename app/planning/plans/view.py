"""A plan with its sessions, their predictions, what speaks against it, and the state of its signature."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.evaluation import repository as evaluations
from app.evaluation import wording
from app.evaluation.ranking.answer import Row
from app.evaluation.ranking.judged import Judged, judged
from app.evaluation.ranking.service import evaluation_notes
from app.evaluation.ranking.staleness import stale_reasons
from app.planning.grounds import events_against, unanswered
from app.planning.notices import Code, PlanWarning, without_policies
from app.planning.plans import repository
from app.planning.plans.designs import Planned, bounds_of
from app.planning.plans.limits import require_limits
from app.planning.plans.sign_off import CommonLimits, common_limits, sealed, signature_of
from app.planning.plans.visits import today
from app.planning.plans.wording import ANSWER_EVENT, happened
from app.planning.protocol.schedule import due_before
from app.platform.audit.signatures import SignatureState
from app.platform.errors import BetaloopError, Conflict, Invalid, NotFound
from app.platform.web.templates import Part, make_part
from app.study import access
from app.study.adverse_events import Events
from app.study.characteristics import fields_of
from app.tables.audit import Signature
from app.tables.evaluations import Evaluation
from app.tables.learning import Policy
from app.tables.participants import Participant
from app.tables.plans import Plan, PlanItem
from app.tables.sessions import Controller
from app.tables.visits import Visit
from ml.ope import Estimate


@dataclass(frozen=True)
class PlanLine:
    """One session of a plan with what is known about it.

    Attributes:
        start_minute: from the first session's start.
        estimate: of the pinned evaluation's method, as it was; None for what was not ranked.
        row: what that evaluation says of the policy against cDBS, judged by the margins in force now; None as above.
        predicted_energy: mean squared amplitude fraction; 1 for cDBS and 0 for no-DBS by definition, else as the estimate predicts.
        design: what a random session shall try, in a draft with the bounds of today; None for other sessions.
    """

    item: PlanItem
    start_minute: float
    policy: Policy | None
    estimate: Estimate | None
    row: Row | None
    predicted_energy: float | None
    design: Planned | None


@dataclass(frozen=True)
class PlanView:
    """A plan with its visit, its sessions, the ranking it rests on, and what speaks against it today."""

    plan: Plan
    visit: Visit
    lines: list[PlanLine]
    evaluation: Evaluation | None
    stale_reasons: list[str]
    warnings: list[PlanWarning]
    signature: Signature | None
    signature_state: SignatureState
    unanswered: Events
    """By policy, the adverse events for which it is neither signed nor run (`app.planning.grounds.unanswered`)."""

    @property
    def sealed(self) -> bool:
        """True while it is hidden which session is which (`app.planning.plans.sign_off`)."""
        return sealed(self.plan)

    @property
    def total_minutes(self) -> float:
        """From the first session's start to the last one's end."""
        return self.lines[-1].start_minute + self.lines[-1].item.minutes


def read_plan(db: Session, visit: Visit, caller: Caller) -> PlanView:
    """Read the plan of a visit. Raises NotFound when there is none."""
    access.require(caller, can.READ, visit.participant)
    plan = repository.live_plan(db, visit.id)
    if plan is None:
        raise NotFound(
            f"Visit {visit.number} of participant {visit.participant.code} has no plan yet.",
            "Choose policies in the ranking and draft one, or post their ids here.",
        )
    return view_of(db, plan, visit)


def medication_due(visit: Visit, plan: Plan) -> list[str]:
    """Describe what is due before each session by the participant's present schedule; empty where none is, or no time is planned."""
    if plan.starts_at is None:
        return [""] * len(plan.items)
    lengths = [i.minutes + i.washout_minutes + i.break_minutes for i in plan.items]
    return due_before(lengths, plan.starts_at, fields_of(visit.participant.current_characteristics).medication)


def refuse_withdrawn(view: PlanView) -> None:
    """Raise Conflict for a plan with a policy that was retired after it was drafted."""
    for line in view.lines:
        if line.policy and line.policy.retired_reason:
            raise Conflict(
                f"Policy '{line.policy.name}' was retired after this plan was drafted: {line.policy.retired_reason}.",
                "Draft the visit again.",
            )


def refuse_after_events(view: PlanView) -> None:
    """Refuse a plan with a policy with a serious event or a stop that was neither cleared nor answered. Raises Conflict."""
    names = {line.policy.id: line.policy.name for line in view.lines if line.policy}
    for policy_id, events in view.unanswered.items():
        # of a sealed plan neither policy nor event is named, for the event may reveal the policy
        what = happened(None if view.sealed else names[policy_id], events)
        may_not = "be signed" if view.plan.status == "draft" else "run"
        raise Conflict(f"Plan {view.plan.id} of visit {view.visit.number} may not {may_not}: {what}.", ANSWER_EVENT)


def refuse_running(view: PlanView) -> None:
    """Require that a plan may run in a participant: signed, unchanged since, no policy withdrawn, the cDBS amplitude that was signed.

    Nor may one run with a policy that has a serious event or a stop, until a clinician has cleared it.

    Raises:
        Conflict: one of these fails; it says which. Invalid: the cDBS amplitude is no longer known.
    """
    if view.plan.status != "approved" or view.signature_state is not SignatureState.STANDS:
        why = {
            SignatureState.NONE: "is not signed yet",
            SignatureState.BROKEN: "was changed after it was signed",
            SignatureState.NOT_KEPT: "was approved by an earlier version, which kept no signature",
            SignatureState.STANDS: "was replaced",
        }[view.signature_state]
        raise Conflict(f"Plan {view.plan.id} of visit {view.visit.number} {why}.", "Draft the visit again, and have a clinician sign it.")
    refuse_withdrawn(view)
    refuse_after_events(view)
    require_limits(view.visit, view.plan.items)


def shown(view: PlanView) -> PlanView:
    """Convert the plan for pages, routes and the sheet: of a sealed one only letters and common limits, which reveal no controller."""
    if not view.sealed:
        return view
    limits = common_limits(view.plan.items)
    lines = [
        PlanLine(_masked(line.item, limits), line.start_minute, policy=None, estimate=None, row=None, predicted_energy=None, design=None)
        for line in view.lines
    ]
    return replace(view, lines=lines, warnings=without_policies(view.warnings))


def standings_of(db: Session, view: PlanView, caller: Caller) -> list[str]:
    """Return a sentence on the standing of each policy that a plan shows; a sealed one shows none."""
    planned = {line.policy.id for line in shown(view).lines if line.policy}
    return [text for i, text in make_part(Part.STANDINGS, db, view.visit.participant, caller).items() if i in planned] if planned else []


def _masked(item: PlanItem, limits: CommonLimits | None) -> PlanItem:
    """Copy a session without its controller: an object of no database session."""
    masked = PlanItem(
        position=item.position,
        minutes=item.minutes,
        washout_minutes=item.washout_minutes,
        break_minutes=item.break_minutes,
        medication=item.medication,
        note=item.note,
        label=item.label,
        hemisphere=item.hemisphere,
        repeat=1,
    )
    if limits is not None:
        masked.min_ma, masked.max_ma, masked.ramp_ma_per_s = limits.min_ma, limits.max_ma, limits.ramp_ma_per_s
    return masked


def view_of(db: Session, plan: Plan, visit: Visit) -> PlanView:
    """Load a plan with all that is known about it."""
    evaluation = repository.evaluation(db, plan.evaluation_id) if plan.evaluation_id else None
    found = judged(db, visit.participant, evaluation) if evaluation else None
    estimates = {a.policy.id: a.estimate for a in found.assessment.assessed} if found else {}
    policies = evaluations.policies_by_id(db, [i.policy_id for i in plan.items if i.policy_id is not None])
    lines, start = [], 0.0
    for item in plan.items:
        estimate = estimates.get(item.policy_id) if item.policy_id else None
        policy = policies.get(item.policy_id) if item.policy_id else None
        row = found.answer.everyone().get(policy.id) if found and policy else None
        lines.append(PlanLine(item, start, policy, estimate, row, _energy(item, estimate), _design(visit, item)))
        start += item.minutes + item.washout_minutes + item.break_minutes
    stale = _stale_reasons(db, visit.participant, evaluation)
    state, signature = signature_of(db, visit, plan, policies)
    against = unanswered(plan, events_against(db, visit.participant))
    warnings = _warnings(db, visit, plan, lines, found, stale, against)
    return PlanView(plan, visit, lines, evaluation, stale, warnings, signature, state, against)


def _design(visit: Visit, item: PlanItem) -> Planned | None:
    if item.design is None:
        return None
    design = Planned.from_json(item.design)
    if design.bounds or not design.holds:
        return design
    try:
        return replace(design, bounds=bounds_of(visit, visit.participant.current_settings, design.bound))
    except Invalid:
        return design  # a warning of the plan says what is missing, and approving it is refused


def _energy(item: PlanItem, estimate: Estimate | None) -> float | None:
    fixed = {Controller.CDBS: 1.0, Controller.NO_DBS: 0.0}.get(Controller(item.controller))
    if fixed is not None or estimate is None:
        return fixed
    predicted = estimate.predicted.get("energy")
    return None if predicted is None else float(predicted)


def _stale_reasons(db: Session, participant: Participant, evaluation: Evaluation | None) -> list[str]:
    newest = evaluations.newest_evaluation(db, participant.id)
    if evaluation is None or newest is None:
        return []
    if newest.id != evaluation.id:
        return [f"there is a newer ranking (evaluation {newest.id}); this plan rests on evaluation {evaluation.id}"]
    return [wording.sentence(reason) for reason in stale_reasons(db, participant, evaluation)]


def _warnings(
    db: Session, visit: Visit, plan: Plan, lines: Sequence[PlanLine], found: Judged | None, stale: Sequence[str], against: Events
) -> list[PlanWarning]:
    names = {line.policy.id: line.policy.name for line in lines if line.policy}
    warnings = [PlanWarning(Code.ADVERSE_EVENT, policy_id, names[policy_id], {"events": events}) for policy_id, events in against.items()]
    warnings += [PlanWarning(Code.STALE_RANKING, values={"reason": reason}) for reason in stale]
    if found:
        warnings += [PlanWarning(Code.RANKING_NOTE, values={"text": text}) for text in evaluation_notes(found)]
    elif any(line.policy for line in lines):
        warnings.append(PlanWarning(Code.NOT_EVALUATED))
    for line in {line.policy.id: line for line in lines if line.policy}.values():
        warnings += _of_policy(line, found)
    if len({line.policy.id for line in lines if line.policy}) == 1:
        warnings.append(PlanWarning(Code.ONE_POLICY))
    if names and visit.participant.margins_lock is None:
        warnings.append(PlanWarning(Code.MARGINS_NOT_LOCKED))
    if plan.status == "draft":
        try:
            require_limits(visit, plan.items)
        except BetaloopError as error:
            warnings.append(PlanWarning(Code.CANNOT_BE_SIGNED, values={"why": str(error)}))
    held = repository.session_count(db, visit.id)
    if not held and medication_due(visit, plan) != [line.item.medication for line in lines]:
        warnings.append(PlanWarning(Code.OTHER_MEDICATION))
    if held:
        warnings.append(PlanWarning(Code.VISIT_HELD, values={"sessions": held}))
    if plan.status == "draft" and visit.date and visit.date < today():
        warnings.append(PlanWarning(Code.DATE_PAST, values={"date": visit.date.isoformat()}))
    if plan.key_opened_at is not None and plan.key_opened_reason is None:
        warnings.append(PlanWarning(Code.KEY_REASON_MISSING, values={"by": plan.key_opened_by}))
    return warnings


def _of_policy(line: PlanLine, found: Judged | None) -> list[PlanWarning]:
    """List what speaks against one policy of a plan."""
    policy, item, estimate = line.policy, line.item, line.estimate
    if policy is None:
        return []
    said: list[tuple[Code, dict[str, Any]]] = []
    if item.min_fraction is not None:
        said.append((Code.LOWEST_AMPLITUDE, {"fraction": item.min_fraction, "cdbs_ma": found.cdbs_ma if found else None}))
    if item.override_reason:
        said.append((Code.OVERRIDDEN, {"reason": item.override_reason}))
    if found and estimate is None:
        said.append((Code.NOT_RANKED, {}))
    if estimate and not estimate.supported:
        said.append((Code.NOT_SUPPORTED, {"flags": estimate.flags}))
    elif estimate and estimate.flags:
        said.append((Code.FLAGS, {"flags": estimate.flags}))
    if policy.retired_reason:
        said.append((Code.RETIRED, {"reason": policy.retired_reason}))
    return [PlanWarning(code, policy.id, policy.name, values) for code, values in said]
