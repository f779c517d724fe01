"""Every sentence of evaluation, made from typed flags at the last moment. Nothing is ever concluded from these texts."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any, TypeVar

from app.evaluation.schemas import EstimateSummary, FlagOut, ReasonOut
from app.platform.numbers import counted, ma
from ml.ope import Estimate, Flag, shown
from ml.outcomes import ALL_PREDICTED, ANY_PREDICTED, OUTCOMES

UNSUPPORTED = "not supported by the data"


def sentence(flag: Flag) -> str:
    """Write one flag in words, without a full stop, for lists and tooltips; an unknown code is shown unchanged."""
    made = _SENTENCES.get(flag.code)
    return made(flag) if made is not None else flag.code.replace("_", " ")


def joined(flags: Sequence[Flag]) -> str:
    """Write several flags in one line."""
    return "; ".join(sentence(flag) for flag in flags)


def count_stops(flag: Flag) -> str:
    """Return how many sessions were stopped for the participant's sake."""
    return f"{counted(int(number(flag)), 'session')} stopped for the participant's sake"


def amplitude(fraction: float, value_ma: float | None) -> str:
    """Format an amplitude in mA; as a share of cDBS where that is not known in mA."""
    return f"{ma(value_ma)} mA" if value_ma is not None else f"{percent(fraction)} of the cDBS amplitude"


def chance(share: float) -> str:
    """Write a probability from some hundred draws: they can show none of 0 and none of 1."""
    return "> 99 %" if share > 0.99 else "< 1 %" if share < 0.01 else percent(share)


def method_name(key: str) -> str:
    """Return the name of a method on pages; its key where this betaloop has no such method."""
    return shown(key).name


def signed(value: float, digits: int = 1) -> str:
    """Write a difference with its sign."""
    shown = round(value, digits)
    return f"{shown:+.{digits}f}".replace("-", "\N{MINUS SIGN}") if shown else f"{0:.{digits}f}"


def percent(share: float | None) -> str:
    """Write a share in whole per cent."""
    return f"{100 * (share or 0.0):.0f} %"


def number(flag: Flag) -> float:
    """Return the number that a flag is about."""
    return flag.value if flag.value is not None else float("nan")


def _refusal(flag: Flag) -> str:
    """Write the beginning of a finding about support: its verdict, and the steps that it is about."""
    return (f"{UNSUPPORTED}: " if flag.refuses else "") + ("in its simulated sessions, " if flag.source == "simulated" else "")


def _thin(flag: Flag) -> str:
    span = dict(flag.facts)
    logged = f" (logged steps span {span['low']:.2f} to {span['high']:.2f})" if span else ""
    return f"{_refusal(flag)}in {percent(flag.value)} of steps the policy asks for amplitudes with hardly any logged step near them{logged}"


def shape_pooling(outcome: str, told: Mapping[str, Any]) -> str:
    """Describe the result of pooling an outcome's dose shapes (`ml.ope.outcomes.pooling.Proof.to_json`), for engineers."""
    n, gain, error = told["participants"] - 1, told["gain"], told["standard_error"]
    others, needed = counted(n, "other participant"), told["fewest"] - 1
    if n < needed:
        has = "has" if n == 1 else "have"
        return f"{outcome}: not pooled, because {others} of the site {has} an evaluation that tells of it, and {needed} are needed"
    size = f"{signed(gain, 2)} ± {error:.2f} nats"
    if told["used"]:
        own = signed(told["own_gain"], 2)
        return f"{outcome}: dose shapes pooled with {others}: gain {size} for whoever is left out, {own} for this participant"
    return f"{outcome}: not pooled with {others}, because it does not help whoever is left out: gain {size}"


OUTCOME_NAMES = {o.field: o.noun for o in OUTCOMES}
OUTCOMES_WITH_UNITS = {
    "r_end": "End-of-session reward",
    **{o.field: f"{o.short} ({o.difference_unit})" for o in OUTCOMES},
}

_UNSKILLED = {
    "no_better_than_equal": "left-out sessions are predicted no better than by calling all of them equal",
    "contrasts_not_reproduced": "how controllers differed in the sessions is predicted the other way round",
    "too_few_left_out_sessions": "too few sessions could be left out to see whether they are predicted",
    "levels_follow_dose": "beta drifted along with the dose, so that the two cannot be told apart",
}
"""Why the data cannot order policies, by the codes of `ml.ope.posterior.skill`."""


def _no_ordering_skill(flag: Flag) -> str:
    why = [_UNSKILLED.get(code, code.replace("_", " ")) for code in flag.fact("reasons")]
    return "the data cannot order policies" + (f": {', and '.join(why)}" if why else "")


def _sessions_changed(flag: Flag) -> str:
    what = {
        "newer": "newer: visit " + ", ".join(flag.fact("visits")),
        "unconfirmed": "no longer confirmed",
        "qoc": "with corrected outcomes",
        "conditions": "whose conditions were corrected",
        "left_out": "newly left out",
        "included": "newly included",
        "decoded": "decoded anew",
        "cdbs": "with another cDBS amplitude",
        "doses": "with other doses of medication at their visit",
        "retimed": "whose start was corrected, for its clock was wrong",
        "moved": "whose times, control channel, controller or stop were corrected",
    }
    return f"{counted(int(number(flag)), 'session')} {what[flag.fact('change')]}"


def _policies_missing(flag: Flag) -> str:
    names, n = flag.fact("names"), int(number(flag))
    listed = ", ".join(names) + (f" and {n - len(names)} more" if n > len(names) else "")
    return f"{counted(n, 'policy', 'policies')} not in it: {listed}"


def _reference(flag: Flag) -> str:
    return "The cDBS reference" + ("" if flag.fact("supported") else ", which the data do not support,")


def _cdbs_above(flag: Flag) -> str:
    which = "candidate" if flag.fact("above_all") else "supported candidate"
    return (
        f"{_reference(flag)} is estimated at {flag.limit:.1f}, above every {which} (best: {flag.fact('best')}, {number(flag):.1f}): "
        f"by this estimate no {which} improves on cDBS in return.{' The intervals overlap.' if flag.fact('overlap') else ''}"
    )


def _tests_not_counted(flag: Flag) -> str:
    why = {
        "without_cdbs": "at a visit without cDBS",
        "of_unknown_noise": "with outcomes of which nothing tells yet how far sessions differ by chance",
        "without_policy": "of a policy that cannot be replayed, because its file is gone or it takes other windows",
    }
    parts = [f"{flag.fact(name):.0f} {text}" for name, text in why.items() if flag.fact(name)]
    return f"{counted(int(number(flag)), 'session')} of tested policies not counted in full: {', '.join(parts)}"


_SENTENCES: dict[str, Callable[[Flag], str]] = {
    # of estimates and of what the data cover
    "thin": _thin,
    "outside_range": lambda f: (
        f"{_refusal(f)}in {percent(f.value)} of steps the policy leaves the logged amplitudes ({f.fact('low'):.2f} to {f.fact('high'):.2f})"
    ),
    "far": lambda f: (
        f"{_refusal(f)}{percent(f.value)} of the policy's state-amplitude pairs lie further from any logged pair than "
        f"{f.fact('times'):.0f} times the distance that holds 95 % of the logged ones"
    ),
    "no_closed_loop": lambda f: f"{_refusal(f)}no closed loop: about {percent(f.value)} of the cDBS amplitude whatever beta does",
    "as_good_as_off": lambda f: (
        f"{_refusal(f)}as good as no stimulation in {percent(f.value)} of steps (below {percent(f.fact('below'))} of cDBS)"
    ),
    "below_random_bound": lambda f: (
        f"in {percent(f.value)} of steps the policy asks for less than {f.fact('bound'):.2f}, the least that the random controller gave: "
        "only sessions of other controllers speak there"
    ),
    "unseen_dose": lambda f: (
        f"in {percent(f.value)} of steps the policy's average amplitude over the last minute is one that no session held: what it does "
        "there is a model's guess"
    ),
    "few_near_sessions": lambda f: (
        f"{_refusal(f)}{counted(int(number(f)), 'session')} came near what it would do; {f.limit:.0f} on two visits are needed"
    ),
    "few_near_visits": lambda f: (
        f"{_refusal(f)}all sessions that came near what it would do are of {counted(int(number(f)), 'visit')}, and {f.limit:.0f} are needed"
    ),
    "not_converged": lambda f: (
        f"{_refusal(f)}not converged: its ratios break the equation that defines them by {number(f):.2f} standard deviations "
        f"(limit {f.limit:.2f})"
    ),
    "few_effective_sessions": lambda f: f"{_refusal(f)}the weights rest on {number(f):.1f} effective sessions of {f.fact('sessions'):.0f}",
    "acts_within_hold": lambda f: (
        f"{_refusal(f)}the policy acts within amplitudes that were drawn once and held, in "
        f"{counted(round(number(f)), 'session')}: importance weights cannot tell what it would have done"
    ),
    "hold_density_unknown": lambda f: (
        f"{_refusal(f)}the held amplitudes of {counted(round(number(f)), 'session')} were drawn by no stated design, "
        "so that they have no weight"
    ),
    "few_sessions_behind_correction": lambda f: (
        f"the correction of the value function rests on {number(f):.1f} effective sessions of {f.fact('sessions'):.0f}"
    ),
    "weights_need_sessions": lambda f: (
        f"importance weights rest on {number(f):.1f} effective sessions of {f.fact('sessions'):.0f}; {f.limit:.0f} are needed"
    ),
    "few_end_rewards": lambda f: "fewer than three sessions have an end-of-session reward: the estimate is the step return alone",
    "no_end_reward": lambda f: "no session has an end-of-session reward: the estimate is the step return alone",
    "days_unknown": lambda f: "how returns differ from day to day cannot be told from these sessions: the intervals leave it out",
    "stopped_sessions": lambda f: (
        f"{counted(int(number(f)), 'session')} stopped for the participant's sake: counted as failures with the worst outcomes. "
        f"Counted as measured, the end-of-session reward would be {f.fact('measured'):.1f} instead of {f.fact('counted'):.1f}"
    ),
    "tests_not_counted": _tests_not_counted,
    "no_better_than_mean": lambda f: (
        f"left-out sessions are predicted no better than by the mean of the others (error {number(f):.2f} of that one's)"
    ),
    "members_discarded": lambda f: (
        f"{number(f):.0f} of {f.limit or 0:.0f} models of the ensemble were left out, because their answer to a lasting dose is none, or "
        "the opposite of that within the random sessions"
    ),
    "no_answer_to_amplitude": lambda f: (
        "the model's answer to the amplitude is no better than none: in left-out sessions it misses how controllers differ"
    ),
    # of verdicts
    "retired": lambda f: f"retired: {f.fact('text')}",
    "no_posterior": lambda f: "this ranking does not have the chances of every outcome: evaluate again",
    "all_below_zero": lambda f: "its whole estimated gain over cDBS is below 0",
    "coverage_unchecked": lambda f: f"what the data cover could not be checked: {f.fact('text')}",
    "reference_missing": lambda f: "the cDBS reference, which it is held against, has no estimate",
    "reference_unsupported": lambda f: "the data do not support the cDBS reference, which it is held against",
    "outcomes_unknown": lambda f: f"no session has {ANY_PREDICTED}: whether it is worse than cDBS cannot be told",
    "energy_unknown": lambda f: "its energy is not predicted",
    "no_ordering_skill": _no_ordering_skill,
    "undecided": lambda f: "neither likely enough to be within the margins nor likely enough to be beyond one",
    "adverse_event": lambda f: "a serious adverse event under it has not been cleared by a clinician",
    "stopped": lambda f: f"{count_stops(f)}, and no clinician has cleared {'it' if f.value == 1 else 'them'}",
    "nearly_off": lambda f: f"nearly off, below 20 % of the cDBS amplitude, {percent(f.value)} of the time (at most {percent(f.limit)})",
    "beyond_margin": lambda f: (
        f"{chance(number(f))} likely beyond twice a margin of {ANY_PREDICTED}, most often that of {OUTCOME_NAMES[f.fact('outcome')]} "
        f"(unsafe from {percent(f.limit)})"
    ),
    "likely_beyond_margin": lambda f: (
        f"{chance(number(f))} likely beyond a margin of {ANY_PREDICTED}, most often that of {OUTCOME_NAMES[f.fact('outcome')]} "
        f"(likely worse from {percent(f.limit)})"
    ),
    "extrapolates": lambda f: (
        f"it would hold {percent(f.value)} of the cDBS amplitude on average; the lowest that two sessions held is {percent(f.limit)}"
    ),
    "acts_like_cdbs": lambda f: f"acts like cDBS: {percent(f.value)} of its amplitude away from it on average",
    "within_margins": lambda f: f"{chance(number(f))} likely within the margins of {ALL_PREDICTED} (a test asks for {percent(f.limit)})",
    "saves_energy": lambda f: f"{chance(number(f))} likely to use less energy (a test asks for {percent(f.limit)})",
    "visits_needed": lambda f: f"on {counted(int(number(f)), 'visit')}",
    "not_settled_by_sessions": lambda f: "more sessions held near what it does would not settle it",
    "sessions_needed": lambda f: counted(int(number(f)), "session"),
    "near_amplitude": lambda f: f"held near {ma(f.value)} mA" if f.unit == "mA" else f"held near {percent(f.value)} of the cDBS amplitude",
    # of a ranking that the study has left behind
    "settings_changed": lambda f: f"settings version {number(f):.0f} is in force; this ranking used version {f.limit:.0f}",
    "sessions_changed": _sessions_changed,
    "no_threshold": lambda f: "the participant has no beta threshold xi_beta any more",
    "policies_missing": _policies_missing,
    # notes above a ranking, whole sentences
    "none_supported": lambda f: "No candidate is supported by the data: these estimates cannot say whether one improves on cDBS.",
    "cdbs_above": _cdbs_above,
    "cdbs_overlaps": lambda f: (
        f"{_reference(f)} is estimated at {f.limit:.1f}, the best candidate, {f.fact('best')}, at {number(f):.1f}; the intervals overlap: "
        "whether it improves on cDBS in return is open."
    ),
    "placed_below": lambda f: (
        "Hardly any session came near what these do; value and place are guesses: " + ", ".join(f.fact("policies")) + "."
    ),
}


# Estimates and their flags as types of the API.

Shown = TypeVar("Shown", bound=EstimateSummary)


def flag_out(flag: Flag) -> FlagOut:
    """Return a flag with its sentence."""
    return FlagOut(code=flag.code, value=flag.value, limit=flag.limit, unit=flag.unit, text=sentence(flag))


def reason_out(flag: Flag) -> ReasonOut:
    """Return a flag as values alone."""
    return ReasonOut(code=flag.code, value=flag.value, limit=flag.limit, unit=flag.unit)


def estimate_out(estimate: Estimate, shape: type[Shown]) -> Shown:
    """Return an estimate in one of the shapes of the API: each of its fields is the estimate's of the same name."""
    values = {name: getattr(estimate, name) for name in shape.model_fields}
    return shape.model_validate(values | {"flags": [flag_out(flag) for flag in estimate.flags]})
