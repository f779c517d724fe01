"""Sentences about plans, made of typed values at the last moment; nothing reads them back."""

from __future__ import annotations

from collections.abc import Sequence

from app.evaluation.ranking.verdict_wording import plainly
from app.evaluation.wording import amplitude, chance, joined
from app.planning.notices import OF_METHODS, Code, PlanWarning
from app.planning.plans.designs import NEAR, Planned, SideBound, delivered_ma, is_held
from app.planning.plans.suggested import Held
from app.planning.protocol.schedule import Order
from app.platform.numbers import counted, elapsed_time, ma
from app.study.blinding import CONTROLLER_NAMES
from app.tables.adverse_events import AdverseEvent
from app.tables.plans import Plan, PlanItem
from app.tables.sessions import Controller
from ml.deploy.manifest import BundleManifest
from ml.designs import HOLD_SECONDS, LOW_AMPLITUDE, LOW_SECONDS, NEAR_SPREAD
from ml.ope import Suggestion

LEAVE_AT_ONCE = "A stop, an adverse event or a lost link: back to cDBS at once; the rest of the session is not made up for."


def release_reason(manifest: BundleManifest) -> str:
    """Describe why a bundle's bytes were stored, for the audit trail; of a blinded plan nothing that distinguishes its sessions."""
    if manifest.slot is not None and manifest.slot.label:
        place = f"session {manifest.slot.position} of plan {manifest.slot.plan_id}"
        return f"session bundle of a blinded plan: {place}, {manifest.participant}"
    side = f", {manifest.hemisphere}" if manifest.hemisphere else ""
    what = f"policy {manifest.policy_id}" if manifest.schedule is None else manifest.policy_name
    slot = f", session {manifest.slot.position} of plan {manifest.slot.plan_id}" if manifest.slot else ""
    return (
        f"controller bundle of {manifest.participant}, {what}{side}{slot}: {manifest.min_ma:g} to {manifest.max_ma:g} mA, "
        f"cDBS {manifest.cdbs_ma:g} mA, ramp {manifest.ramp_ma_per_s:g} mA/s"
    )


_ABOUT: dict[Code, str] = {
    Code.STALE_RANKING: "The ranking is out of date: {reason}.",
    Code.RANKING_NOTE: "{text}",
    Code.NOT_EVALUATED: "No ranking stands behind this plan: the participant's policies have not been evaluated.",
    Code.OVERRIDDEN: "Policy '{policy}' is unsafe and planned all the same: {reason}.",
    Code.NOT_RANKED: "Policy '{policy}' is not in the ranking.",
    Code.NOT_SUPPORTED: "The recordings say too little of what policy '{policy}' does to rely on what is expected of it{flags}.",
    Code.FLAGS: "Policy '{policy}': {flags}.",
    Code.RETIRED: "Policy '{policy}' was retired: {reason}.",
    Code.CANNOT_BE_SIGNED: "The plan cannot be signed: {why}",
    Code.DATE_PAST: "The visit's date, {date}, is past.",
    Code.ONE_POLICY: "The visit tests a single policy; the protocol tests 2 to 4, each against the others and cDBS of the same day.",
    Code.MARGINS_NOT_LOCKED: "Nobody has locked the margins: sessions of this plan can never confirm a policy. Lock them on the page of "
    "the margins before the plan is signed.",
    Code.KEY_REASON_MISSING: "The key was opened in an emergency by {by}; the reason is still missing.",
    Code.OTHER_MEDICATION: "The participant's medication schedule was changed after this plan was drafted: what is due before its "
    "sessions is that of the draft. Draft it anew for the present one.",
}


ANSWER_EVENT = (
    "Clear the event with a reason on the page of adverse events; or draft the visit again, without the policy or with the reason why it "
    "is tested all the same, and have it signed."
)
"""Way of a plan, or a policy's bundle, to run again after a serious adverse event."""


def happened(policy: str | None, events: Sequence[AdverseEvent]) -> str:
    """Return in one clause what no clinician has cleared of a policy.

    Args:
        policy: its name; None where it is hidden which one it is. events: the adverse events; none where they would reveal it.
    """
    if policy is None:
        return "a serious adverse event or a stop, which no clinician has cleared, stands against a policy of it"
    one, serious = len(events) == 1, [event for event in events if event.now.serious]
    which = f"adverse event{'' if one else 's'} {_listed([event.id for event in events])}"
    kind = "serious" if len(serious) == len(events) else "serious or stops" if serious else "a stop" if one else "stops"
    kind += "" if serious else " for the participant's sake"
    return f"{which} under policy '{policy}' {'is' if one else 'are'} {kind}, and no clinician has cleared {'it' if one else 'them'}"


def _listed(numbers: Sequence[int]) -> str:
    """List numbers as "3", "3 and 4", "3, 4 and 5"."""
    *first, last = map(str, numbers)
    return f"{', '.join(first)} and {last}" if first else last


def warning(found: PlanWarning) -> str:
    """Write the sentence of a warning."""
    values = dict(found.values) | {"policy": found.policy}
    if found.code is Code.ADVERSE_EVENT:
        return f"The plan may not run: {happened(found.policy, values.get('events', ()))}. {ANSWER_EVENT}"
    if found.code is Code.LOWEST_AMPLITUDE:
        fraction, cdbs_ma = values["fraction"], values["cdbs_ma"]
        return f"Policy '{found.policy}' may not go below {amplitude(fraction, None if cdbs_ma is None else fraction * cdbs_ma)}."
    if found.code is Code.VISIT_HELD:
        return f"The visit already has {values['sessions']} {'session' if values['sessions'] == 1 else 'sessions'}."
    if found.code is Code.NOT_SUPPORTED:
        why = plainly(values["flags"])
        values["flags"] = f": {why}" if why else ""
    elif found.code is Code.FLAGS:
        values["flags"] = joined(values["flags"])
    return _ABOUT[found.code].format(**values)


def plain_warnings(warnings: Sequence[PlanWarning]) -> list[tuple[PlanWarning, str]]:
    """Select the warnings for those who sign or run the plan, with their sentences; what is about methods is in plain words or excluded."""
    told = []
    for found in warnings:
        if found.code not in OF_METHODS:
            told.append((found, warning(found)))
        elif "flags" in found.values and (why := plainly(found.values["flags"])):
            told.append((found, f"Policy '{found.policy}': {why}."))
    return told


def method_notes(warnings: Sequence[PlanWarning]) -> list[str]:
    """List what engineers read of the ranking behind a plan."""
    return [warning(found) for found in warnings if found.code in OF_METHODS]


STOP_RULES = (
    "Stop the session and return to the clinical stimulation (cDBS) at once when the participant asks for it; on a fall or its risk; "
    "on troublesome tremor, dyskinesia, dystonia, or change of speech, mood or sight; when sensing or the link to the device is lost; or "
    "when the amplitude leaves the clinician's limits. The study protocol's stop rules prevail over this sheet."
)


def suggestion(why: Suggestion, first: bool) -> str:
    """Describe why a policy is suggested for a visit, in one sentence."""
    than = "than cDBS" if first else "than all above"
    tells = f"; its test alone would settle {chance(why.informs)} of what is open about the others" if why.informs >= TELLING else ""
    return f"{chance(why.better)} likely to turn out better on the whole {than}{tells}."


def holding(held: Held) -> str:
    """Describe what sessions near an amplitude would show, in one sentence."""
    further = held.hold.further
    if further is None:
        return (
            "The recordings cannot tell policies apart. This is the lowest amplitude that a whole session may hold: beside cDBS it shows "
            "best whether doses differ; no number of sessions is known to settle it."
        )
    names = [f"'{policy.name}'" for policy in held.policies]
    of = names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
    visits = f" on {further.visits} visits" if further.visits > 1 else ""
    is_worth = f"{of} {'is' if len(names) == 1 else 'are'} worth a test"
    now = f"; {held.hold.here} of them at this visit" if held.hold.here < further.sessions else ""
    return f"{counted(further.sessions, 'session')} held near it{visits} would tell whether {is_worth}{now}."


TELLING = 0.2
"""Share of what is open about the other candidates from which a policy's test counts as informative about them."""


def scheduled_name(design: str, level: float | None) -> str:
    """Name a session without a policy, as its bundle does."""
    if design == NEAR and level is not None:
        return f"session held near {level:.2f} of cDBS"
    return "cDBS" if design == "constant" else f"random session, {design} design"


def design_name(planned: Planned) -> str:
    """Name a design in two words, for a table."""
    if planned.design == NEAR:
        return f"held near {_near(planned)}"
    return {"paper": "paper's draws", "ladder": "titration ladder"}.get(planned.design) or f"level {planned.level:.2f} of cDBS"


def design_words(planned: Planned) -> str:
    """Describe what a random session tries, in one clause."""
    if planned.design == "paper":
        return f"the paper's design: a new draw every {planned.period_s:g} s, uniform from {planned.bound:g} to 1 of cDBS"
    if planned.design == "ladder":
        steps = ", ".join(f"{h.amplitude:g}" for h in planned.holds)
        return f"titration ladder: {steps} of cDBS, {planned.holds[0].steps * planned.period_s / 60:g} min each"
    low, high = HOLD_SECONDS
    if planned.design == NEAR:
        words = f"held near {_near(planned)}: {len(planned.holds)} draws within {NEAR_SPREAD:g} of it, each held {low:g} to {high:g} s"
        guarded = f"; just above {LOW_AMPLITUDE:g} until the last {LOW_SECONDS / 60:g} min"
        return words + (guarded if (planned.level or 0.0) < LOW_AMPLITUDE else "")
    return f"stratified design: level {planned.level:.2f} of cDBS, {len(planned.holds)} draws held {low:g} to {high:g} s"


def _near(planned: Planned) -> str:
    """Format the amplitude near which a session stays: milliamperes by side where they are known, and the share of cDBS."""
    share = f"{planned.level:.2f} of cDBS"
    given = ", ".join(_side(b, f"{ma((planned.level or 0.0) * b.cdbs_ma)} mA") for b in planned.bounds)
    return f"{given} ({share})" if given else share


def bound_words(planned: Planned, bounds: tuple[SideBound, ...]) -> str:
    """Describe what a random session never does, in milliamperes where the cDBS amplitude is known."""
    if not bounds:
        return f"never below {planned.bound:g} of cDBS; its cDBS amplitude is not known, so that no bound in mA can be given"
    lowest = ", ".join(_side(b, f"{ma(b.lowest_ma)} mA") for b in bounds)
    words = f"never below {lowest} ({planned.bound:g} of cDBS)"
    if planned.low_seconds:
        low = ", ".join(_side(b, f"{ma(b.low_ma)} mA") for b in bounds)
        words += f"; below {low} ({LOW_AMPLITUDE:g}) for {planned.low_seconds / 60:.1f} of at most {LOW_SECONDS / 60:g} min"
        words += "" if planned.design == "ladder" else ", at the end"
    return words


def schedule_words(planned: Planned, bounds: tuple[SideBound, ...]) -> str:
    """List every amplitude with the minute it begins at: milliamperes by side, fractions of cDBS where those are not known."""
    held = [f"{elapsed_time(h.start * planned.period_s)} {_given(h.amplitude, bounds)}" for h in planned.holds]
    last = planned.holds[-1]
    after = [f"{elapsed_time((last.start + last.steps) * planned.period_s)} cDBS"]  # a ladder may end before the session does
    return "  ".join(held + after)


def session_name(item: PlanItem, policy: str | None = None) -> str:
    """Name a session of a plan: its controller, and its letter in a blinded plan; the letter alone while the key is sealed.

    Args:
        item: the session.
        policy: name of its policy, since each policy counts its sessions from 1; None where the name is next to it.
    """
    if not item.controller:
        return f"Session {item.label}"
    name = "Held" if is_held(item) else CONTROLLER_NAMES[Controller(item.controller)]
    name += f" {policy}" if policy else ""
    name += f" {item.repeat}" if item.repeat > 1 else ""
    return f"{name} ({item.label})" if item.label else name


ORDER_NAMES = {
    Order.DRAWN: "by lot",
    Order.WILLIAMS: "Williams' design, balanced over visits",
    Order.LATIN_SQUARE: "Latin square, balanced over visits",
    Order.STATED: "as stated",
}


def order_words(plan: Plan) -> str:
    """Describe how the order of a plan's policies was found."""
    order = Order(plan.rules.get("order", Order.DRAWN))
    block = f", block {plan.rules.get('block', 0) + 1}" if order in (Order.WILLIAMS, Order.LATIN_SQUARE) else ""
    return ORDER_NAMES[order] + block


def limits_ma(item: PlanItem) -> str:
    """Format the limits of a planned session, mA."""
    if item.min_ma is None or item.max_ma is None:
        return "not set"
    return f"{item.min_ma:g}" if item.min_ma == item.max_ma else f"{item.min_ma:g} to {item.max_ma:g}"


def _given(fraction: float, bounds: tuple[SideBound, ...]) -> str:
    return "/".join(ma(delivered_ma(fraction, b)) for b in bounds) or f"{fraction:.2f}"


def _side(bound: SideBound, words: str) -> str:
    return f"{words} {bound.side}" if bound.side else words
