"""Sentences of the analyses, made where they are shown; nothing is decided by them."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from app.analysis.facts import Excluded, LeftOut, Missing
from app.analysis.primary_results import Basis, Comparison, Disagreement, Tested
from app.analysis.primary_verdict import LockedMargins, NoVerdict, VerdictResult
from app.platform.numbers import counted, p_text
from app.study.blinding import CONTROLLER_NAMES
from ml.outcomes import ALL_JUDGED, BY_KEY, JUDGED, OUTCOMES, enumerated
from ml.outcomes.records import Outcome
from ml.statistics.noninferiority import ENERGY, LEAST_VISITS, FailureRule, Inconclusive, Inferior, NonInferiorAndSaving, Verdict
from ml.statistics.pooling import Summary
from ml.statistics.power import MOST_VISITS
from ml.statistics.within_visits.contrasts import Adjustment, Reason, Unavailable

TITLES: dict[str, tuple[str, str]] = {
    "energy": ("Stimulation energy", "share of cDBS"),
    "mean_beta": ("Mean beta amplitude", ""),
    **{o.key: (o.label, o.unit) for o in OUTCOMES},
}
"""The paper's five metrics: title and unit; the unit of beta is the participant's."""

ENERGY_SHOWN = ("% of cDBS", 100.0)
"""How every page and figure shows energy: unit, and factor of the stored share of the energy under cDBS. Files and the REST interface keep
the share."""

_MODELLED = {"ordinal": "ordered categories", "minutes": "minutes out of those watched (from the share and the length of the session)"}
_EFFECTS = {"ordinal": "log odds of a higher one", "minutes": "log odds of a minute with it"}
NAMES = {o.key: o.the_noun for o in JUDGED} | {ENERGY: "the energy saved"}
"""Names of what a verdict judges, within a sentence."""
ORDINAL = enumerated([o.the_noun for o in OUTCOMES if o.scale == "ordinal"])
BOUNDED = enumerated([o.noun for o in OUTCOMES if o.bounded]).capitalize()
MODELS = " ".join(f"{o.the_noun.capitalize()} is taken as {_MODELLED[o.model]}." for o in OUTCOMES if o.model in _MODELLED)
"""How the mixed models take what is not measured on a scale."""
_SHARED = enumerated([o.label.lower() for o in JUDGED if o.margin.kind == "share"] or ["outcome"], "or")

FAMILY = (
    "Planned family: the five metrics of RL and of distilled RL, each against the same visit's cDBS; p-values are adjusted by Holm over "
    "all of them that could be tested. Everything else (other controllers, single policies) is exploration, adjusted by Benjamini and "
    "Hochberg: a value below .05 there is a lead to follow, not a result."
)
STRATEGY = (
    "A controller counts with every session of it, whichever policy ran, so that nothing is selected by its outcome. A single policy is "
    "judged by the sessions that began after its confirmation was declared. Without a declaration these are the sessions after it was last "
    "put on an approved plan; what was known before may have picked it, and does not count."
)
SEVERAL_DECLARED = "Each declared confirmation is tested at 5 % by itself; nothing is adjusted for their number."
ADJUSTMENTS = {
    Adjustment.NONE: "Not adjusted",
    Adjustment.ORDER: "Freed from a linear drift over the visit",
    Adjustment.CARRY_OVER: "Freed from what ran just before",
    Adjustment.MEDICATION: "Freed from the time since the last dose",
    Adjustment.BRACKETED: "Only sessions between two cDBS sessions",
    Adjustment.SKEWNESS: "Freed from skewed contrasts",
}
RULES = {
    FailureRule.WORST_CASE: "a stopped session of the controller counts as a failure, a stopped cDBS session as measured",
    FailureRule.BOTH_ARMS: "stopped sessions of both arms count as failures",
    FailureRule.AS_MEASURED: "stopped sessions count as measured",
    FailureRule.END_OF_SCALE: "a stopped session of the controller counts as the worst that the scales allow, "
    + ", ".join(f"{o.noun} {o.worst_possible:g}" for o in OUTCOMES),
}
MISSING = {
    Missing.NOT_ENTERED: "nobody entered it",
    Missing.NO_TRACE: "its recordings hold no such trace",
    Missing.MOSTLY_UNKNOWN: "more than half of its steps are not known",
    Missing.NO_CDBS_AMPLITUDE: "no cDBS amplitude is stated for its side and program, so that no fraction follows",
    Missing.OTHER_BETA: "its beta is of another unit or source",
}


def unavailable(why: Unavailable, what: str = "the controller") -> str:
    """Explain why a number is not given."""
    sentences = {
        Reason.NO_SESSION: f"No session of {what}, or none of cDBS, has this metric.",
        Reason.NO_VISIT_WITH_BOTH_ARMS: f"No visit has both {what} and cDBS with this metric: no primary evidence.",
        Reason.TOO_FEW_VISITS: f"{counted(why.found, 'visit')} with both arms; it takes {why.needed}.",
        Reason.TOO_FEW_PARTICIPANTS: f"{counted(why.found, 'participant')} with a result; it takes {why.needed}.",
        Reason.TOO_FEW_SESSIONS: "One session of either arm at one visit does not tell how much sessions differ.",
        Reason.ALL_EQUAL: "Every session has the same value, which does not tell how far another could differ: nothing can be tested.",
        Reason.NO_VARIANCE: f"{_upper(what)} differs from cDBS by the same at every visit, which does not tell how far another visit could "
        "be off: nothing can be tested.",
        Reason.ONE_VISIT: "All that varies, varies in one visit alone.",
        Reason.NOT_IDENTIFIED: "The sessions do not tell this apart from the controller.",
        Reason.NOT_RECORDED: "What it takes was not recorded.",
        Reason.NO_BRACKETED_SESSION: "No session stands between two cDBS sessions of its visit.",
    }
    return sentences[why.reason]


def not_pooled(why: Unavailable) -> str:
    """Explain why a metric has no summary over participants."""
    return "Beta of different unit or source is not pooled." if why.reason is Reason.NOT_IDENTIFIED else unavailable(why)


def tested_name(tested: Tested) -> str:
    """Name a controller, or a policy of it."""
    if tested.policy_id is None:
        return CONTROLLER_NAMES[tested.controller]
    return tested.policy_name or f"policy {tested.policy_id}"


def basis(tested: Tested) -> str:
    """Describe which sessions of a policy count, and which do not; empty for controllers."""
    if tested.basis is Basis.ALL:
        return ""
    if tested.basis is Basis.SELECTION:
        return "selection: these sessions may have picked the policy, and confirm nothing"
    left = len(tested.selection_sessions)
    return "confirmation" + (f"; {counted(left, 'earlier session')} that may have picked it left out" if left else "")


def is_open(result: VerdictResult) -> bool:
    """Return whether a verdict settles nothing."""
    return result.assessment is None or isinstance(result.assessment.verdict, Inconclusive)


def verdict(result: VerdictResult, name: str = "") -> str:
    """Return the verdict in one sentence that a clinician can quote; `name` is the policy's, where it is not on a whole controller."""
    name = name or CONTROLLER_NAMES[result.controller]
    if result.assessment is None:
        if result.no_verdict is NoVerdict.NO_VISIT_AFTER_LOCK and result.locked.until is not None:
            return f"No verdict on {name}: no visit began while these margins were locked."
        if result.no_verdict is NoVerdict.NO_VISIT_AFTER_LOCK:
            since = "its confirmation was declared" if result.locked.declared_at else "the margins were locked"
            return f"No verdict on {name} yet: no visit was recorded after {since}."
        return f"No verdict on {name}: no cDBS session has a {_SHARED} above 0, of which the margin would be a share."
    sentence = verdict_sentence(name, result.assessment.verdict, len(result.visits), planned=result.locked.until is None)
    return f"{sentence} {late_stops(result.late_stops)}".rstrip()


def late_stops(sessions: Sequence[int]) -> str:
    """Return what a verdict does not count: stops that became known after a lock; empty without any."""
    if not sessions:
        return ""
    of = f"Session{'s' if len(sessions) > 1 else ''} {_numbers(sessions)} {'were' if len(sessions) > 1 else 'was'} stopped"
    return f"{of} for the participant's sake, which became known after the visit was locked: counted here as measured, not as failures."


def policy_shares(shares: Sequence[float]) -> str:
    """Say how often the policy decided in the sessions with a log; empty without any."""
    if not shares:
        return ""
    low, high = f"{100 * min(shares):.0f}", f"{100 * max(shares):.0f}"
    return (
        f"The policy decided in {low if low == high else f'{low} to {high}'} % of the periods of {counted(len(shares), 'logged session')}."
    )


def verdict_sentence(name: str, found: Verdict, visits: int, *, planned: bool) -> str:
    """Write a verdict over so many visits in one sentence. `planned`: the number of further visits that would settle it was requested."""
    over = f"over {counted(visits, 'visit')}"
    if isinstance(found, NonInferiorAndSaving):
        return (
            f"{name} is non-inferior to cDBS on {ALL_JUDGED} and saves {found.percent:.0f} % of the stimulation energy "
            f"(95 % interval {found.low:.0f} to {found.high:.0f} %), {over}."
        )
    if isinstance(found, Inferior):
        return f"{name} is inferior to cDBS: {_listed(found.outcomes)} {_are(found.outcomes)} worse by more than the margin, {over}."
    open_ = f"{name} is not shown to be non-inferior on {_listed(found.open)}"
    if found.open == (ENERGY,):
        open_ = f"{name} is non-inferior on {ALL_JUDGED}, but a saving of energy is not shown"
    more = _more(found, planned=planned)
    if not visits and more:
        return f"Nothing can be said of {name} yet: {more}."
    return f"Inconclusive {over}: {open_}{f'; {more}' if more else ''}."


def _more(found: Inconclusive, *, planned: bool = True) -> str:
    short = [name for name, why in found.untested if why is Reason.TOO_FEW_VISITS]
    with_ = "both arms" if {*short, ENERGY} >= NAMES.keys() else f"{_listed(short)} in both arms" if short else ""
    few = f"nothing is concluded from fewer than {LEAST_VISITS} visits with {with_}" if short else ""
    if found.more_visits is not None:
        more = (
            f"{counted(found.more_visits, 'more visit')} with both arms would settle it with a probability of 80 %, if what was seen holds"
        )
        return f"{few}; {more}" if few else more
    if few:
        return few
    if why := found.untested or found.unplanned:
        return "; ".join(_not_told(reason, [name for name, r in why if r is reason]) for reason in dict.fromkeys(r for _, r in why))
    if not planned:
        return ""
    return f"by what was seen so far, even {MOST_VISITS} more visits would not settle it"


def _not_told(why: Reason, names: Sequence[str]) -> str:
    """Explain why outcomes of a verdict could not be tested, or why no number of further visits follows from them."""
    what, are = _listed(names), _are(names)
    unknown = "which does not tell how far another could be off"
    sentences = {
        Reason.NO_SESSION: f"no session of it, or none of cDBS, has {what}",
        Reason.NO_VISIT_WITH_BOTH_ARMS: f"no visit has {what} of both arms",
        Reason.TOO_FEW_SESSIONS: f"one session of either arm at one visit does not tell how much {what} {_differ(names)} between sessions",
        Reason.ALL_EQUAL: f"{what} {are} the same in every session, {unknown}",
        Reason.NO_VARIANCE: f"{what} {are} better or worse than under cDBS by the same at every visit, {unknown}",
        Reason.NOT_IDENTIFIED: f"at a visit cDBS has no stimulation energy of which {what} would be a share",
    }
    return sentences.get(why) or f"{what}: {unavailable(Unavailable(why)).rstrip('.')}"


def outlook(result: VerdictResult, sessions_per_arm: int) -> str:
    """Describe what further visits would settle of a controller, for the plan of the next one."""
    name, a = CONTROLLER_NAMES[result.controller], result.assessment
    if a is None or not isinstance(a.verdict, Inconclusive):
        return verdict(result)
    return f"{_outlook(name, a.verdict, sessions_per_arm)} {late_stops(result.late_stops)}".rstrip()


def _outlook(name: str, verdict_now: Inconclusive, sessions_per_arm: int) -> str:
    if verdict_now.more_visits is None:
        return f"{name}: {_more(verdict_now)}."
    visits, arms = counted(verdict_now.more_visits, "more visit"), counted(sessions_per_arm, "session")
    settled = f"{name}: {visits}, each with {arms} of it and as many of cDBS, would show with a probability of 80 % that it saves energy"
    settled += " without loss, if what was seen holds"
    if verdict_now.fewest_visits is not None and verdict_now.fewest_visits < verdict_now.more_visits:
        return f"{settled}. With more sessions at each it is {counted(verdict_now.fewest_visits, 'visit')} at the least."
    return f"{settled}. More sessions at a visit would not replace one."


def effect_unit(metric: str, unit: str) -> str:
    """Return the unit in which a mixed model states its effect on a metric."""
    return _EFFECTS.get(BY_KEY[metric].model, unit) if metric in BY_KEY else unit


def share_margins(locked: LockedMargins) -> str:
    """Describe which margins are shares, and of what."""
    shares = [o for o in JUDGED if o.margin.kind == "share"]
    return " ".join(f"The margin of {o.noun} is {100 * locked.margins.of(o):g} % of the mean under cDBS." for o in shares)


def judged_as(outcome: str, unit: str) -> str:
    """Return the unit in which an outcome of a verdict and its margin are stated."""
    return BY_KEY[outcome].contrast_unit if outcome in BY_KEY else unit


def verdict_kind(result: VerdictResult) -> str:
    """Describe whether a verdict confirms, and why not."""
    return f"{'Confirmatory' if result.confirmatory else 'Exploratory'}: {verdict_ground(result)}"


def verdict_ground(result: VerdictResult) -> str:
    """Explain why a verdict confirms, or does not; the text follows that word."""
    locked = result.locked
    if result.confirmatory:
        before = "declaration" if locked.declared_at else "lock"
        left = f" Visits before the {before} ({_numbers(result.left_to_exploration)}) are left out." if result.left_to_exploration else ""
        if locked.declared_at is not None:
            return (
                f"its confirmation was declared on {locked.declared_at:%Y-%m-%d %H:%M} UTC by {locked.declared_by}, by the margins "
                f"(version {locked.version}) that were locked then. All of its sessions in visits that began later count, whatever was "
                f"planned.{left}"
            )
        return (
            f"the margins (version {locked.version}) were locked on {locked.locked_at:%Y-%m-%d %H:%M} UTC by "
            f"{locked.locked_by}, before every session that counts here.{_superseded(locked)}{left}"
        )
    if locked.locked_at is None:
        return (
            "nobody has locked the margins, so that they could still be chosen by the data. Visits that begin before a lock can never "
            "confirm."
        )
    return "this takes in visits from before the margins were locked; it does not confirm."


def _superseded(locked: LockedMargins) -> str:
    """State when a newer lock followed."""
    if locked.until is None:
        return ""
    return f" A newer lock followed on {locked.until:%Y-%m-%d %H:%M} UTC; visits that began after it are judged by that one."


def margins(found: LockedMargins) -> str:
    """Write the margins in a line."""
    return ", ".join(f"{o.noun} {margin(o, found.margins.of(o))}" for o in JUDGED)


def margin(outcome: Outcome, value: float) -> str:
    """Write a margin with its unit."""
    if outcome.margin.kind == "share":
        return f"{100 * value:g} % of cDBS"
    return counted(value, "point") if outcome.margin.form_unit == "points" else f"{value:g} {outcome.margin.form_unit}"


def disagreement(found: Comparison) -> str:
    """Describe where the paper's test and the primary one differ; empty where they agree."""
    if found.disagreement is Disagreement.PAPER_ONLY:
        return (
            "The paper's test is below .05 and the primary one is not: to take sessions of one day as independent makes days look like "
            "evidence."
        )
    if found.disagreement is Disagreement.PRIMARY_ONLY:
        return "The primary test is below .05 and the paper's is not: differences between days hide what is the same within them."
    if found.disagreement is Disagreement.NO_PRIMARY:
        return "The paper's test is below .05, but there is no primary evidence: days and controllers cannot be told apart."
    return ""


def lacking(found: Comparison) -> str:
    """Describe the visits that give no primary evidence; empty where all do."""
    if not found.lacking_visits:
        return ""
    one = len(found.lacking_visits) == 1
    lacks, give = ("lacks", "gives") if one else ("lack", "give")
    visits = f"{'Visit' if one else 'Visits'} {_numbers(found.lacking_visits)}"
    return f"{visits} {lacks} one of the arms with this metric and {give} no primary evidence."


def left_out(excluded: Excluded) -> str:
    """Explain why a session counts in no analysis."""
    return {
        LeftOut.EXCLUDED: excluded.detail,
        LeftOut.NOT_CONFIRMED: "not confirmed yet",
        LeftOut.UNREADABLE: f"cannot be read: {excluded.detail}",
        LeftOut.HIDDEN: "hidden from you until its visit is locked",
        LeftOut.SEALED: "the key of its visit's blinded plan is sealed",
    }[excluded.why]


def no_association(why: Unavailable) -> str:
    """Explain why two measurements are not compared."""
    if why.reason is Reason.TOO_FEW_VISITS:
        return f"{counted(why.found, 'visit')} can be compared; {why.needed} are needed."
    sentences = {
        Reason.ALL_EQUAL: "One of the two does not vary.",
        Reason.ONE_VISIT: "One visit alone carries it: without that visit one of the two does not vary.",
        Reason.NO_VARIANCE: "Every visit shows the same slope, which does not tell how far another could be off.",
    }
    return sentences.get(why.reason) or unavailable(why)


def no_population_claim(found: Summary) -> str:
    """Describe what a summary of so few participants does not show."""
    k = found.participants
    floor = f"With {k} participants the two-sided sign test cannot go below {p_text(found.smallest_sign_p)}"
    if found.population_claim:
        return f"{floor}; the summary describes these {k} participants, and their spread is shown beside it."
    return f"{floor}: the summary describes these {k} participants and claims nothing about other people."


def _listed(names: Sequence[str]) -> str:
    return enumerated([NAMES.get(n, n) for n in names])


def _are(names: Sequence[str]) -> str:
    return "is" if len(names) == 1 else "are"


def _differ(names: Sequence[str]) -> str:
    return "differs" if len(names) == 1 else "differ"


def _upper(text: str) -> str:
    return text[:1].upper() + text[1:]


def _numbers(numbers: Iterable[int]) -> str:
    return ", ".join(map(str, numbers))


def shown_unit(metric: str, unit: str) -> str:
    """Return the unit in which pages and figures show a metric whose own unit is `unit`."""
    return ENERGY_SHOWN[0] if metric == "energy" else unit


def shown_factor(metric: str) -> float:
    """Return the factor that converts a metric's numbers to `shown_unit`."""
    return ENERGY_SHOWN[1] if metric == "energy" else 1.0
