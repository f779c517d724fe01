"""Bundles for the sessions of a signed plan: what runs on a participant, on that day, once. The caller commits."""

from __future__ import annotations

import secrets
from dataclasses import replace
from datetime import UTC, date, datetime

from sqlalchemy.orm import Session

from app import __version__
from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.learning import repository as learning
from app.planning.bundles import ports, repository, service
from app.planning.grounds import events_against, unanswered
from app.planning.plans import wording
from app.planning.plans.designs import Planned, seed_of
from app.planning.plans.limits import device_limits
from app.planning.plans.sign_off import common_limits
from app.planning.plans.view import PlanLine, PlanView, read_plan, refuse_running, shown
from app.planning.plans.visits import today
from app.planning.sheet.content import BUNDLE, card_of
from app.platform import files
from app.platform.errors import Conflict, Invalid, NotFound
from app.study import access
from app.study.adverse_events import with_blocking_events
from app.tables.audit import Signature
from app.tables.participants import Hemisphere
from app.tables.plans import PlanItem
from app.tables.sessions import Controller
from app.tables.visits import Visit
from ml.deploy.blinding import Common, blind, room_for
from ml.deploy.bundle import build_scheduled_bundle, sign
from ml.deploy.manifest import Approval, BundleError, BundleManifest, PlanCard
from ml.deploy.runtime.schedule import Schedule, ScheduledHold
from ml.deploy.runtime.slot import Slot, Withdrawals, withdrawals_body
from ml.designs import Decision, DesignSettings, lay_out


def bundle(db: Session, visit: Visit, position: int, caller: Caller, at: datetime | None = None) -> tuple[str, bytes]:
    """Return the signed bundle of one session of a visit's signed plan, and its file name. Stored when first taken; each release is
    recorded.

    Args:
        at: when it is taken; now, but in the study in silico, whose calendar is in the past.

    Raises:
        NotFound: no plan, or no such session. Conflict: the plan may not run, the visit has no date or is past, or the session has no
            bundle, as one without stimulation. Invalid: it cannot be made. Forbidden: the caller may only read.
    """
    access.require(caller, can.TAKE_BUNDLES, visit.participant)
    view = read_plan(db, visit, caller)
    signature = runnable(view, at.date() if at else None)
    line = next((line for line in view.lines if line.item.position == position), None)
    if line is None:
        raise NotFound(f"Plan {view.plan.id} has no session {position}.", f"Name one from 1 to {len(view.lines)}.")
    code = visit.participant.code
    slot = _slot(view, line.item, signature, at or datetime.now(UTC))
    windows = None
    if line.policy is not None:
        limits = service.Limits(line.item.min_ma, line.item.max_ma, line.item.ramp_ma_per_s)
        side = Hemisphere(line.item.hemisphere) if line.item.hemisphere else None
        manifest, windows = service.manifest_of(db, visit.participant, line.policy, limits, side, caller)
        manifest = replace(
            manifest, slot=slot, card=_card(db, view, line), approvals=_approvals(view, signature), limits_stated_by=_stated_by(signature)
        )
    else:
        manifest = _scheduled(db, view, line, slot, signature, caller)

    def make() -> bytes:
        if line.policy is not None and windows is not None:
            made = service.policy_bundle(line.policy, manifest, windows)
        else:
            made = sign(build_scheduled_bundle(manifest), service.signing_key())
        return _blinded(view, made) if view.sealed else made

    content = service.content_of(manifest, windows, line.policy, manifest.limits_stated_by)
    signed = service.take(db, visit.participant, manifest, content, make, caller, line.item.id)
    return f"{code}-visit-{visit.number}-session-{position}.zip", signed


def _blinded(view: PlanView, content: bytes) -> bytes:
    """Build the bundle of a blinded plan, of which all sessions look alike."""
    limits, settings = common_limits(view.plan.items), view.visit.participant.current_settings
    if limits is None:
        raise Conflict(f"Plan {view.plan.id} has no limits in mA.", "Draft the visit again.")
    common = Common(limits.min_ma, limits.max_ma, limits.ramp_ma_per_s, settings.window, settings.period_s)
    room = room_for(max((len(files.read(line.policy.onnx_sha256)) for line in view.lines if line.policy), default=0))
    return sign(blind(content, common, secrets.token_hex(16), room), service.signing_key())


def runnable(view: PlanView, day: date | None = None) -> Signature:
    """Return the signature under which a plan may run on a day, today where none is named. Raises Conflict, Invalid where it may not."""
    refuse_running(view)
    if view.visit.date is None:
        raise Conflict(f"Visit {view.visit.number} has no date, and a bundle runs on the day of its visit alone.", "Date the visit.")
    if view.visit.date < (day or today()):
        raise Conflict(f"Visit {view.visit.number} was on {view.visit.date}; its bundles have expired.", "Plan another visit.")
    if view.signature is None:
        raise Conflict(f"Plan {view.plan.id} is not signed.", "Have a clinician sign it.")
    return view.signature


def withdrawals(db: Session) -> bytes:
    """Return the withdrawals as a tablet takes them: a line of JSON, and its signature in a second one.

    Plans that may not run after an adverse event or a stop are among it until it is cleared: their bundles may have left before.
    """
    now = datetime.now(UTC).isoformat(timespec="milliseconds")
    plans = frozenset(repository.withdrawn_plans(db)) | _stopped_plans(db)
    gone = Withdrawals(now, frozenset(repository.withdrawn_policies(db)), plans)
    body = withdrawals_body(gone)
    return body + b"\n" + service.signing_key().sign(body).hex().encode() + b"\n"


def _stopped_plans(db: Session) -> frozenset[int]:
    """List signed plans of this installation with a policy that has a serious event or a stop that is neither cleared nor answered."""
    found: set[int] = set()
    for participant in with_blocking_events(db):
        events = events_against(db, participant)
        found |= {plan.id for plan in repository.signed_plans(db, participant.id) if unanswered(plan, events)}
    return frozenset(found)


def _slot(view: PlanView, item: PlanItem, signature: Signature, at: datetime) -> Slot:
    return Slot(
        plan_id=view.plan.id,
        slot_id=item.id,
        position=item.position,
        visit_number=view.visit.number,
        visit_date=str(view.visit.date),
        controller=str(item.controller),
        minutes=item.minutes,
        plan_sha256=signature.sha256,
        issued_at=at.isoformat(timespec="seconds"),
        label=item.label,
        repeat=item.repeat,
    )


def _card(db: Session, view: PlanView, line: PlanLine) -> PlanCard:
    """Build the sheet's card of a session; while the key is sealed no more than is shown there."""
    seen = shown(view)
    one = next(other for other in seen.lines if other.item.position == line.item.position)
    card = card_of(one, seen, None, {} if view.sealed or line.policy is None else ports.lines_of(db, [line.policy.id]))
    told = tuple((label, text) for label, text in card.lines if label != BUNDLE)
    return PlanCard(
        head=card.head, minutes=card.minutes, lines=told, warnings=card.warnings, stop_rules=wording.STOP_RULES, blinded=view.sealed
    )


def _approvals(view: PlanView, signature: Signature) -> tuple[Approval, ...]:
    what = f"plan {view.plan.id} of visit {view.visit.number}: {signature.meaning}"
    return (Approval(name=signature.signer, role="signer", approved_at=signature.signed_at.isoformat(timespec="seconds"), statement=what),)


def _stated_by(signature: Signature) -> str:
    return f"{signature.signer}, {signature.signed_at.astimezone(UTC):%Y-%m-%d %H:%M} UTC"


def _scheduled(db: Session, view: PlanView, line: PlanLine, slot: Slot, signature: Signature, caller: Caller) -> BundleManifest:
    """Build the manifest of a session whose amplitudes are laid out beforehand."""
    item, participant = line.item, view.visit.participant
    settings = participant.current_settings
    data = learning.newest_snapshot(db, participant.id)
    unit, source = (data.beta_unit, data.beta_source) if data else (settings.beta_unit, settings.beta_source)
    if unit is None or source is None:
        raise Invalid("The unit and source of beta are not known.", "Set beta_unit and beta_source in the participant's settings.")
    if item.cdbs_ma is None or item.min_ma is None or item.max_ma is None or item.ramp_ma_per_s is None:
        raise Conflict(f"Session {item.position} has no limits in mA.", "Draft the visit again.")
    schedule = _schedule(view, item, settings.period_s)
    side = Hemisphere(item.hemisphere) if item.hemisphere else None
    device = device_limits(db, participant, side)
    try:
        return BundleManifest(
            participant=participant.code,
            policy_id=None,
            policy_name=wording.scheduled_name(schedule.design, schedule.level),
            hemisphere=side.value if side else None,
            window=settings.window,
            period_s=settings.period_s,
            beta_unit=unit,
            beta_source=source,
            beta_low_hz=settings.beta_low_hz,
            beta_high_hz=settings.beta_high_hz,
            min_valid_fraction=settings.min_valid_fraction,
            min_ma=item.min_ma,
            max_ma=item.max_ma,
            cdbs_ma=item.cdbs_ma,
            ramp_ma_per_s=item.ramp_ma_per_s,
            limits_stated_by=_stated_by(signature),
            device_min_ma=device.min_ma if device else None,
            device_max_ma=device.max_ma if device else None,
            code_version=__version__,
            taken_by=f"{caller.label}, {datetime.now(UTC):%Y-%m-%d %H:%M:%S.%f} UTC",
            public_key=service.public_key(),
            approvals=_approvals(view, signature),
            slot=slot,
            card=_card(db, view, line),
            schedule=schedule,
            **service.beta_limits(data, settings.window),
        )
    except BundleError as error:
        raise Invalid(f"The bundle of session {item.position} cannot be made: {error}.", "Correct what is named.") from error


def _schedule(view: PlanView, item: PlanItem, period_s: float) -> Schedule:
    """Build what the session delivers: cDBS throughout, or the holds of its design; the paper's draws use a seed of the slot."""
    steps = max(1, round(60 * item.minutes / period_s))
    if item.controller == Controller.CDBS:
        return Schedule("constant", None, None, None, (ScheduledHold(0, steps, 1.0, None),))
    if item.controller == Controller.NO_DBS:
        raise Conflict(
            f"Session {item.position} runs without stimulation, which no bundle does: the tablet's fall-back is cDBS.",
            "Switch the stimulation off, and on again, with the programmer.",
        )
    if item.design is None:
        raise Conflict(f"Session {item.position} has neither policy nor design.", "Draft the visit again.")
    planned = Planned.from_json(item.design)
    if planned.period_s != period_s:
        raise Conflict(
            f"Session {item.position} was laid out in steps of {planned.period_s:g} s, and the period is {period_s:g} s now.",
            "Draft the visit again.",
        )
    if planned.holds:
        return Schedule(planned.design, planned.level, planned.seed, planned.bound, _holds(planned.holds))
    seed = seed_of(f"{view.visit.participant.code}/{item.id}", view.plan.id)
    wanted = DesignSettings(name="paper", visits=1, sessions=1, steps=steps, period_s=period_s, bound=planned.bound, seed=seed)
    (session,) = lay_out(wanted)
    return Schedule("paper", None, seed, planned.bound, _holds(session.decisions))


def _holds(decisions: tuple[Decision, ...]) -> tuple[ScheduledHold, ...]:
    return tuple(ScheduledHold(d.start, d.steps, d.amplitude, d.log_density) for d in decisions)
