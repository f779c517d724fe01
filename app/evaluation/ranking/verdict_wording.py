"""The words of a ranking's verdicts, and the sentences on what to test next."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence

from markupsafe import Markup

from app.evaluation import wording
from app.evaluation.ranking.answer import OFF_SHARE, Difference, Group, Row
from app.evaluation.ranking.judged import Judged
from app.evaluation.ranking.results import RandomSessions
from app.evaluation.schemas import Standing, TestedBefore
from app.evaluation.wording import OUTCOME_NAMES, amplitude, chance, count_stops, number, percent, sentence, signed
from app.platform.numbers import counted
from app.platform.web.templates import render_part
from app.study.margins import margins_of
from ml.ope import NEARLY_OFF, RELIABILITY, Flag
from ml.outcomes import ALL_PREDICTED, ANY_PREDICTED, OUTCOMES
from ml.outcomes.records import Outcome
from ml.qoc import Margins

# The words of a ranking's verdicts: what each is called, and its reasons in a line, in full and for a first look.

STANDING_NAMES: dict[Standing, str] = {
    "test": "test",
    "test_with_care": "test with care",
    "same_as_cdbs": "same as cDBS",
    "undecided": "undecided",
    "likely_worse": "likely worse",
    "unsafe": "unsafe",
    "not_advised": "not advised",
    "cannot_tell": "cannot tell",
}

GROUP_NAMES: dict[Group, str] = {
    "proposed": "Suggested tests",
    "open": "Not decided: not likely enough to suggest, and not ruled out",
    "not_advised": "Not advised: planned only with a clinician's stated reason",
}


def decision(reasons: Sequence[Flag]) -> str:
    """Write the reasons of a verdict in one line.

    Args:
        reasons: as `app.evaluation.ranking.decisions.decide` gives them.
    """
    told = [reason for reason in reasons if reason.code not in _FURTHER]
    more = further_sessions(reasons)
    return "; ".join([*map(sentence, told), *([more] if more else [])])


def plainly(reasons: Sequence[Flag], limit: float | None = None, limit_ma: float | None = None) -> str:
    """Write a verdict's reason for a reader in a hurry: the deciding finding in plain words, without methods.

    Args:
        reasons: of the verdict. limit, limit_ma: lowest amplitude of a test with care, fraction of cDBS and mA.
    """
    if limit is not None:
        return f"lower than two sessions ever held: not below {amplitude(limit, limit_ma)}"
    more = further_sessions(reasons)
    found = [_undecided(reasons) if r.code == "undecided" else _PLAINLY[r.code](r) for r in reasons if r.code in _PLAINLY]
    return "; ".join([*found[:2], *([more] if more else [])])


def _undecided(reasons: Sequence[Flag]) -> str:
    """Describe what a test requires and the policy does not reach: which of the two probabilities of a verdict is too low."""
    low = {r.code: r for r in reasons if r.code in _TEST_ASKS and r.value is not None and r.limit is not None and r.value < r.limit}
    told = [f"a test asks for {percent(low[code].limit)} {words}" for code, words in _TEST_ASKS.items() if code in low]
    return f"not sure enough: {', and '.join(told)}" if told else "whether it is no worse than cDBS is still open"


def likely(within: float) -> str:
    """Write the chance that no outcome is worse than its margin allows; always in these words, as a shorter form reads as another claim.

    Args:
        within: that probability.
    """
    return f"{chance(within)} chance that {ALL_PREDICTED} all stay within the margins"


def further_sessions(reasons: Sequence[Flag]) -> str:
    """Describe how many further sessions near which amplitude, on how many visits, would decide; empty where none is named."""
    by_code = {reason.code: reason for reason in reasons}
    if not {"sessions_needed", "near_amplitude"} <= by_code.keys():
        return ""
    told = [sentence(by_code[code]) for code in ("sessions_needed", "near_amplitude", "visits_needed") if code in by_code]
    return f"{' '.join(told)} would tell"


def random_effects(found: RandomSessions) -> tuple[list[str], list[str]]:
    """Describe what random sessions changed against cDBS, and the worst of a single one, by outcome."""
    known = [o for o in OUTCOMES if o.field in found.differences]
    apart = [change(o.noun, found.differences[o.field], o.decimals, o.difference_words) for o in known]
    return apart, [f"{o.noun} {found.worst[o.field]:.{0 if o.whole else o.decimals}f} {o.sentence_unit}" for o in known]


def usual(under_cdbs: Mapping[str, float]) -> list[str]:
    """Describe what is to be expected under cDBS, by outcome."""
    known = [o for o in OUTCOMES if o.field in under_cdbs]
    return [f"{o.noun} {under_cdbs[o.field]:.{o.decimals}f} {o.sentence_unit} {o.note}".rstrip() for o in known]


def allowed(margins: Margins, under_cdbs: Mapping[str, float]) -> list[str]:
    """Describe how much worse than under cDBS each outcome may be, and what that is of the value to expect."""
    return [_allowed(o, margins.of(o), under_cdbs.get(o.field)) for o in OUTCOMES]


def _allowed(outcome: Outcome, margin: float, under_cdbs: float | None) -> str:
    amount = f"{100 * margin:.0f} %" if outcome.margin.kind == "share" else counted(margin, outcome.difference_words.removesuffix("s"))
    of = ""
    if under_cdbs is not None and outcome.margin.kind == "share":
        of = f" ({outcome.margin.amount(margin, under_cdbs):.{outcome.mean_decimals}f} {outcome.sentence_unit})"
    elif under_cdbs is not None and not outcome.higher_is_better:
        of = f" (up to {min(outcome.high, under_cdbs + margin):.{outcome.decimals}f} {outcome.sentence_unit})"
    return f"{outcome.noun} at most {amount} {outcome.worse}{of}"


def effect(differences: Mapping[str, Difference], within: float | None = None) -> str:
    """Describe what a policy is expected to change against cDBS, in one line.

    Args:
        differences: by quantity, as the answer's rows have them. within: as `likely` has it; no word of it where that is None.
    """
    told = [
        change(name, scale * differences[quantity].value, digits, unit)
        for quantity, name, scale, digits, unit in _CHANGES
        if quantity in differences
    ]
    return (", ".join(told) or "what it would change is not estimated") + ("" if within is None else f"; {likely(within)}")


def reliability() -> str:
    """Compare stated chances with how often they were true of virtual patients."""
    first, *others = ((percent(stated), percent(true)) for _, stated, true in RELIABILITY)
    listed = "; ".join(f"of {stated}, {true}" for stated, true in others)
    return f"of policies called {first[0]} likely no worse, {first[1]} were; {listed}"


def dose_words(row: Row, cdbs_ma: float | None) -> str:
    """Say how far a policy adapts its amplitude to beta, and what that is estimated to add; empty where neither is known.

    Args:
        row: of the policy. cdbs_ma: the cDBS amplitude, mA; None where it is not known.
    """

    def dose(fraction: float) -> str:
        return amplitude(fraction, None if cdbs_ma is None else fraction * cdbs_ma)

    found, adapts, adds = [], row.adapts, row.adds
    if adapts is not None:
        how = "same as" if adapts.fixed else "adapts to beta around"
        found.append(f"{how} {dose(adapts.mean)}{' all the time' if adapts.fixed else ''}: {dose(adapts.low)} to {dose(adapts.high)}")
    if adds is not None:
        points = f"{signed(adds.value)} points of the return ({signed(adds.low)} to {signed(adds.high)})"
        open_yet = "" if adds.low > 0 or adds.high < 0 else ", so that it may be nothing"
        found.append(f"adapting to beta adds {points} to {dose(adds.amplitude)} all the time{open_yet}")
    return "; ".join(found)


def test_results(results: TestedBefore | None) -> str:
    """Return what a policy's own sessions showed: how many, how many were stopped, and the differences to the same day's cDBS."""
    if results is None:
        return "never run so far"
    told = [f"{counted(results.sessions, 'session')} so far"]
    if results.stopped:
        told.append(f"{results.stopped} stopped for the participant's sake")
    known = [(getattr(results, f"{quantity}_difference"), *words) for quantity, *words in _CHANGES]
    apart = [change(name, scale * value, digits, unit) for value, name, scale, digits, unit in known if value is not None]
    told.append("against cDBS of the same day: " + ", ".join(apart) if apart else "no cDBS of the same day")
    return "; ".join(told)


def change(name: str, difference: float, digits: int, unit: str) -> str:
    """Write what changes by how much: signed, with its unit, of one point in the singular; unchanged where it rounds to nothing.

    Args:
        name: of what changes. difference: by how much, in the unit. digits: after the point. unit: its symbol, or a noun in the plural.
    """
    shown = signed(difference, digits)
    if not float(shown.replace("\N{MINUS SIGN}", "-")):
        return f"{name} unchanged"
    return f"{name} {shown} {unit[:-1] if shown[1:] == '1' and unit.endswith('points') else unit}"


_CHANGES = (("energy", "energy", 100, 0, "%"), *((o.field, o.noun, 1, o.decimals, o.difference_words) for o in OUTCOMES))
"""Of each quantity: name, scale, digits, unit."""

_TEST_ASKS = {"within_margins": "likely no worse", "saves_energy": "likely to use less energy"}
_FURTHER = ("sessions_needed", "near_amplitude", "visits_needed")


_PLAINLY: dict[str, Callable[[Flag], str]] = {
    "retired": lambda f: f"retired: {f.fact('text')}",
    "no_posterior": lambda f: "without the chances of every outcome: evaluate again",
    "adverse_event": lambda f: "serious adverse event, not cleared by a clinician",
    "stopped": lambda f: f"{count_stops(f)}, not cleared by a clinician",
    "nearly_off": lambda f: f"nearly off {percent(f.value)} of the time",
    "beyond_margin": lambda f: (
        f"{chance(number(f))} likely that {ANY_PREDICTED} is worse by more than twice its margin, most often "
        f"{OUTCOME_NAMES[f.fact('outcome')]}"
    ),
    "likely_beyond_margin": lambda f: (
        f"{chance(number(f))} likely that {ANY_PREDICTED} is worse by more than its margin, most often {OUTCOME_NAMES[f.fact('outcome')]}"
    ),
    "all_below_zero": lambda f: "its whole expected gain lies below that of cDBS",
    "few_near_sessions": lambda f: "hardly any session came near what it does",
    "few_near_visits": lambda f: "only one visit came near what it does",
    "outside_range": lambda f: "it asks for amplitudes that nobody has tried",
    "thin": lambda f: "it asks for amplitudes that were hardly ever tried",
    "far": lambda f: "it does what no session has shown",
    "unseen_dose": lambda f: f"{percent(f.value)} of the time its average amplitude is one that no session held",
    "below_random_bound": lambda f: f"{percent(f.value)} of the time it goes lower than the random sessions did",
    "no_ordering_skill": lambda f: "the recordings so far cannot tell policies apart",
    "coverage_unchecked": lambda f: "what the recordings cover could not be checked",
    "reference_missing": lambda f: "nothing is known of cDBS to hold it against",
    "reference_unsupported": lambda f: "too few sessions of cDBS to hold it against",
    "outcomes_unknown": lambda f: f"no session has {ANY_PREDICTED}",
    "energy_unknown": lambda f: "whether it uses less energy is not known",
    "undecided": lambda f: _undecided((f,)),
    "acts_like_cdbs": lambda f: f"{percent(f.value)} of the cDBS amplitude away from it on average",
    "not_settled_by_sessions": lambda f: "more sessions near its amplitude would not settle it",
}
"""Texts for the first screen of the ranking, and for plans, by code; codes without one are shown only further down."""


# What to test next, in a few sentences: the first that the ranking and the participant's page say, made and kept once.


def what_next(judged: Judged, *, may_run: bool) -> Markup:
    """Write the sentences on what to do next, as HTML.

    Args:
        judged: the ranking. may_run: whether who reads them may start jobs.
    """
    settings = judged.participant.current_settings
    minutes = judged.evaluation.horizon_steps * settings.period_s / 60

    def write() -> Markup:
        return render_part(
            "evaluation/_next.html",
            base=f"/participants/{judged.participant.code}",
            answer=judged.answer,
            drawn=judged.random_sessions(settings),
            minutes=round(minutes) if minutes >= 1 else round(minutes, 1),
            off_share=OFF_SHARE,
            nearly_off=NEARLY_OFF,
            margins=margins_of(judged.participant.margins_in_force),
            plainly=plainly,
            effect=effect,
            dose_words=dose_words,
            test_results=test_results,
            random_effects=random_effects,
            usual=usual,
            allowed=allowed,
            further=further_sessions,
            amplitude=wording.amplitude,
            chance=wording.chance,
            outcome_names=wording.OUTCOME_NAMES,
            may_run=may_run,
        )

    return judged.kept(("next", judged.participant.code, settings.id, may_run), write)
