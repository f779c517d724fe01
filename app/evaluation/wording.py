"""Every sentence of evaluation, made from typed flags at the last moment. Nothing is ever concluded from what stands here."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from ml.ope.flags import TEXT, Flag
from ml.ope.registry import shown

UNSUPPORTED = "not supported by the data"


def sentence(flag: Flag) -> str:
    """One flag in words, without a full stop, for lists and tooltips; a code that this betaloop does not know is shown as it is."""
    made = _SENTENCES.get(flag.code)
    return made(flag) if made is not None else flag.code.replace("_", " ")


def joined(flags: Sequence[Flag]) -> str:
    """Several flags in one line."""
    return "; ".join(sentence(flag) for flag in flags)


def decision(reasons: Sequence[Flag]) -> str:
    """The reasons of a decision in one line: what it rests on, and what speaks against the policy or that nothing does.

    Args:
        reasons: as `app.evaluation.decision.decide` gives them.
    """
    if not reasons:
        return ""
    first, rest = reasons[0], reasons[1:]
    if first.code == "reference_unsupported":
        return f"{sentence(first)} {joined(rest)}"
    if first.code == "not_supported" and rest:
        return f"{sentence(first)}; {joined(rest)}"
    if first.code == "gain" and rest:
        joint = ": " if rest[0].code in _VERDICTS else ", but "
        return f"{sentence(first)}{joint}{joined(rest)}"
    return joined(reasons)


def choice(reasons: Sequence[Flag]) -> str:
    """Why a method ranks by default, in words; the last reason may be the usual order, which stands in a sentence of its own."""
    usual = [reason for reason in reasons if reason.code == "usual_order"]
    found = [sentence(reason) for reason in reasons if reason.code not in ("usual_order", "beats_usual_order")]
    text = "; ".join(found) + "".join(f", {sentence(reason)}" for reason in reasons if reason.code == "beats_usual_order")
    return ". ".join([text[:1].upper() + text[1:], *(sentence(reason) for reason in usual)])


def method_name(key: str) -> str:
    """What pages call a method; its key where this betaloop has no such method."""
    return shown(key).name


def signed(value: float) -> str:
    """A difference with its sign, to one decimal."""
    shown = round(value, 1)
    return f"{shown:+.1f}".replace("-", "\N{MINUS SIGN}") if shown else "0.0"


def count(n: int, one: str, many: str) -> str:
    """A number with its noun."""
    return f"{n} {one if n == 1 else many}"


def _percent(share: float | None) -> str:
    return f"{100 * (share or 0.0):.0f} %"


def _value(flag: Flag) -> float:
    return flag.value if flag.value is not None else float("nan")


def _refusal(flag: Flag) -> str:
    """The beginning of a finding about support: its verdict, and the steps that it is about."""
    return (f"{UNSUPPORTED}: " if flag.refuses else "") + ("in its simulated sessions, " if flag.source == "simulated" else "")


def _thin(flag: Flag) -> str:
    span = dict(flag.facts)
    logged = f" (logged steps span {span['low']:.2f} to {span['high']:.2f})" if span else ""
    return (
        f"{_refusal(flag)}in {_percent(flag.value)} of steps the policy asks for amplitudes with hardly any logged step near them{logged}"
    )


def _gain(flag: Flag) -> str:
    low, high = signed(flag.fact("low")), signed(flag.fact("high"))
    words = f"gain over cDBS {signed(_value(flag))}, {_percent(flag.fact('level'))} interval {low} to {high}"
    if flag.fact("widened"):
        return words
    return f"{words} (not widened: how {method_name(flag.fact('method'))} errs on controllers that it has not seen is not known)"


def _difference_error(flag: Flag) -> str:
    return (
        f"{method_name(flag.fact('method'))} predicted the differences between {flag.fact('controllers'):.0f} left-out controllers with a "
        f"mean error of {_percent(flag.value)} of their range (least of all: {_percent(flag.limit)})"
    )


def _sessions_changed(flag: Flag) -> str:
    what = {
        "newer": "newer: visit " + ", ".join(flag.fact("visits")),
        "unconfirmed": "no longer confirmed",
        "qoc": "with corrected QoCs",
        "conditions": "whose conditions were corrected",
        "left_out": "newly left out",
        "included": "newly included",
        "decoded": "decoded anew",
        "cdbs": "with another cDBS amplitude",
        "moved": "with other steps: its times, control channel or controller were corrected",
    }
    return f"{count(int(_value(flag)), 'session', 'sessions')} {what[flag.fact('change')]}"


def _policies_missing(flag: Flag) -> str:
    names, n = flag.fact("names"), int(_value(flag))
    listed = ", ".join(names) + (f" and {n - len(names)} more" if n > len(names) else "")
    return f"{count(n, 'policy', 'policies')} not in it: {listed}"


def _reference(flag: Flag) -> str:
    return "The cDBS reference" + ("" if flag.fact("supported") else ", which the data do not support,")


def _cdbs_above(flag: Flag) -> str:
    which = "candidate" if flag.fact("above_all") else "supported candidate"
    return (
        f"{_reference(flag)} is estimated at {flag.limit:.1f}, above every {which} (best: {flag.fact('best')}, {_value(flag):.1f}): "
        f"by this estimate no {which} improves on cDBS in return.{' The intervals overlap.' if flag.fact('overlap') else ''}"
    )


_ALIKE = "better than if it had said that all return the same"

_SENTENCES: dict[str, Callable[[Flag], str]] = {
    TEXT: lambda f: str(f.fact("text")),
    # of estimates and of what the data cover
    "thin": _thin,
    "outside_range": lambda f: (
        f"{_refusal(f)}in {_percent(f.value)} of steps the policy leaves the logged amplitudes "
        f"({f.fact('low'):.2f} to {f.fact('high'):.2f})"
    ),
    "far": lambda f: (
        f"{_refusal(f)}{_percent(f.value)} of the policy's state-amplitude pairs lie further from any logged pair than "
        f"{f.fact('times'):.0f} times the distance that holds 95 % of the logged ones"
    ),
    "no_closed_loop": lambda f: f"{_refusal(f)}no closed loop: about {_percent(f.value)} of the cDBS amplitude whatever beta does",
    "as_good_as_off": lambda f: (
        f"{_refusal(f)}as good as no stimulation in {_percent(f.value)} of steps (below {_percent(f.fact('below'))} of cDBS)"
    ),
    "below_random_bound": lambda f: (
        f"in {_percent(f.value)} of steps the policy asks for less than {f.fact('bound'):.2f}, the least that the random controller gave: "
        "only sessions of other controllers speak there"
    ),
    "unseen_dose": lambda f: (
        f"in {_percent(f.value)} of steps the policy's average amplitude over the last minute is one that no session held: what it does "
        "there is a model's guess"
    ),
    "few_near_sessions": lambda f: (
        f"{_refusal(f)}{count(int(_value(f)), 'session', 'sessions')} came near what it would do; {f.limit:.0f} on two visits are needed"
    ),
    "few_near_visits": lambda f: (
        f"{_refusal(f)}all sessions that came near what it would do are of {count(int(_value(f)), 'visit', 'visits')}, "
        f"and {f.limit:.0f} are needed"
    ),
    "not_converged": lambda f: (
        f"{_refusal(f)}not converged: its ratios break the equation that defines them by {_value(f):.2f} standard deviations "
        f"(limit {f.limit:.2f})"
    ),
    "few_effective_sessions": lambda f: f"{_refusal(f)}the weights rest on {_value(f):.1f} effective sessions of {f.fact('sessions'):.0f}",
    "acts_within_hold": lambda f: (
        f"{_refusal(f)}the policy acts within amplitudes that were drawn once and held, in "
        f"{count(round(_value(f)), 'session', 'sessions')}: importance weights cannot tell what it would have done"
    ),
    "hold_density_unknown": lambda f: (
        f"{_refusal(f)}the held amplitudes of {count(round(_value(f)), 'session', 'sessions')} were drawn by no stated design, "
        "so that they have no weight"
    ),
    "few_sessions_behind_correction": lambda f: (
        f"the correction of the value function rests on {_value(f):.1f} effective sessions of {f.fact('sessions'):.0f}"
    ),
    "weights_need_sessions": lambda f: (
        f"importance weights rest on {_value(f):.1f} effective sessions of {f.fact('sessions'):.0f}; {f.limit:.0f} are needed"
    ),
    "few_end_rewards": lambda f: "fewer than three sessions have an end-of-session reward: the estimate is the step return alone",
    "no_end_reward": lambda f: "no session has an end-of-session reward: the estimate is the step return alone",
    "days_unknown": lambda f: "how returns differ from day to day cannot be told from these sessions: the intervals leave it out",
    "stopped_sessions": lambda f: (
        f"{count(int(_value(f)), 'session', 'sessions')} stopped for the participant's sake: counted as failures with the worst outcomes. "
        f"Counted as measured, the end-of-session reward would be {f.fact('measured'):.1f} instead of {f.fact('counted'):.1f}"
    ),
    "no_better_than_mean": lambda f: (
        f"left-out sessions are predicted no better than by the mean of the others (error {_value(f):.2f} of that one's)"
    ),
    "no_answer_to_amplitude": lambda f: (
        "the model's answer to the amplitude is no better than none: in left-out sessions it misses how controllers differ"
    ),
    # of decisions
    "retired": lambda f: f"retired: {f.fact('text')}",
    "no_estimate": lambda f: f"{method_name(f.fact('method'))} has no estimate of it",
    "not_supported": lambda f: UNSUPPORTED,
    "coverage_unchecked": lambda f: f"what the data cover could not be checked: {f.fact('text')}",
    "reference_missing": lambda f: "the cDBS reference, which it is held against, has no estimate",
    "reference_unsupported": lambda f: "the cDBS reference, which it is held against, is itself",
    "gain": _gain,
    "all_below_zero": lambda f: "all of it below 0",
    "may_be_none": lambda f: "it may be none",
    "nothing_against": lambda f: "its lower 95 % bound is above 0, and no other check speaks against it",
    "rating_lower": lambda f: f"its rating is predicted at {_value(f):.1f} against {f.fact('cdbs'):.1f} under cDBS",
    "tremor_higher": lambda f: f"its tremor is predicted at {_value(f):.0f} % against {f.fact('cdbs'):.0f} % under cDBS",
    "grasp_slower": lambda f: f"its grasp is predicted at {_value(f):.2f} Hz against {f.fact('cdbs'):.2f} Hz under cDBS",
    "method_sees_loss": lambda f: f"{method_name(f.fact('method'))} sees a loss ({signed(f.fact('low'))} to {signed(f.fact('high'))})",
    "returned_less": lambda f: (
        f"its {f.fact('sessions'):.0f} sessions returned {_value(f):.1f} on average, below the estimate's {f.limit:.1f}"
    ),
    # of the choice of a method
    "difference_error": _difference_error,
    "beats_usual_order": lambda f: (
        f"by more than a standard error better than {method_name(f.fact('method'))}, the first of the usual order"
    ),
    "not_beaten": lambda f: "none was better by more than a standard error than this first of the usual order",
    "too_few_controllers": lambda f: f"the data cannot choose: {_value(f):.0f} controllers could be left out, {f.limit:.0f} are needed",
    "not_compared": lambda f: "no method was held against left-out controllers",
    "cannot_choose": lambda f: f"the data cannot choose: {f.fact('text')}",
    "no_skill": lambda f: f"no method predicted left-out controllers {_ALIKE}",
    "best_supports_none": lambda f: (
        f"{method_name(f.fact('method'))} predicted left-out controllers best, but supports none of the candidates"
    ),
    "best_has_no_estimate": lambda f: (
        f"{method_name(f.fact('method'))} predicted left-out controllers best, but has no estimate of these policies"
    ),
    "nor_another": lambda f: f"nor does another one that predicted them {_ALIKE}",
    "skilled": lambda f: f"{method_name(f.fact('method'))} predicted the differences between left-out controllers {_ALIKE}",
    "best_of_supporting": lambda f: f"{method_name(f.fact('method'))} is the best of those that support a candidate",
    "usual_order": lambda f: (
        "Taken is the first method of the usual order that supports a candidate: " + ", ".join(method_name(m) for m in f.fact("methods"))
    ),
    # of a ranking that the study has left behind
    "settings_changed": lambda f: f"settings version {_value(f):.0f} is in force; this ranking used version {f.limit:.0f}",
    "sessions_changed": _sessions_changed,
    "no_threshold": lambda f: "the participant has no beta threshold xi_beta any more",
    "policies_missing": _policies_missing,
    # notes above a ranking, whole sentences
    "none_supported": lambda f: "No candidate is supported by the data: these estimates cannot say whether one improves on cDBS.",
    "cdbs_above": _cdbs_above,
    "cdbs_overlaps": lambda f: (
        f"{_reference(f)} is estimated at {f.limit:.1f}, the best candidate, {f.fact('best')}, at {_value(f):.1f}; the intervals overlap: "
        "whether it improves on cDBS in return is open."
    ),
    "placed_below": lambda f: (
        "Policies that the data do not support stand below all supported ones, whatever their estimated value: "
        + ", ".join(f.fact("policies"))
        + "."
    ),
}

_VERDICTS = ("all_below_zero", "may_be_none", "nothing_against")
