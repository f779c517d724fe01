"""Words of sessions: activities, an order drawn, what contradicts what."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from app.platform.numbers import ma, stated
from app.study.sessions.contradictions import Contradiction, Kind
from app.study.sessions.designs import Drawn
from app.tables.sessions import Activity, Controller

ACTIVITIES = {
    Activity.REST: "sat or lay",
    Activity.LIGHT: "walked, talked",
    Activity.EXERCISE: "exercised",
    Activity.MEAL: "ate",
    Activity.SLEEP: "slept",
}


_SAID = {Controller.CDBS: "Said to be cDBS", Controller.NO_DBS: "Said to be without DBS"}


def sentences(contradictions: Iterable[Contradiction]) -> list[str]:
    """Write what a person should look at, a sentence each."""
    return [_SENTENCES[c.kind](c.facts) for c in contradictions]


def drawn_words(drawn: Drawn) -> str:
    """Describe how a random session's amplitudes were drawn."""
    holds = f", {len(drawn.holds)} held amplitudes" if drawn.holds else ""
    held = f"the amplitudes are held ({len(drawn.holds)} of them) and not drawn every step"
    told = {
        "paper": "the paper's: a new draw every step",
        "stratified": "stratified" + ("" if drawn.level is None else f", level {drawn.level:.2f} of cDBS") + holds,
        "ladder": f"titration ladder{holds}",
        "near": "held near" + (" one amplitude" if drawn.level is None else f" {drawn.level:.2f} of cDBS") + holds,
        "held": f"not stated; {held}: their density is not known",
        "unstated": "not stated; taken for the paper's, a new draw every step, which the amplitudes do not contradict",
    }[drawn.kind]
    return told + (f", seed {drawn.seed}" if drawn.seed is not None else "")


def _day(f: Mapping[str, Any]) -> str:
    clock = f" (UTC{f['utc_offset_h']:+g} h)" if f["utc_offset_h"] else ""
    return f"Recorded on {f['day']}{clock}, but visit {f['visit']} is dated {f['visit_date']}. Correct one of them."


def _start(f: Mapping[str, Any]) -> str:
    return (
        f"Said to start at {f['stated']:%Y-%m-%d %H:%M:%S} UTC, but by the recording's own clock this part of it starts at "
        f"{f['by_clock']:%Y-%m-%d %H:%M:%S} UTC. Tremor minutes are found by the start."
    )


def _side(f: Mapping[str, Any]) -> str:
    return (
        f"Said to be controlled on the {f['stated']} side, but its control trace is of recording {f['recording']}, which is of "
        f"the {f['recorded']} side. Correct the hemisphere, which the hand of the grasp test follows where the participant's is not stated."
    )


def _above_cdbs(f: Mapping[str, Any]) -> str:
    return (
        f"{f['above']} of {f['steps']} steps lie above the cDBS amplitude of {f['cdbs_ma'] or float('nan'):g} mA; "
        "they are kept as they are, and no policy learns from them."
    )


def _amplitude(f: Mapping[str, Any]) -> str:
    of = f" on the {f['side']}" if f["side"] else ""
    share = f"{100 * f['mean_fraction']:.0f} % of the cDBS amplitude" if f["mean_fraction"] is not None else f"{ma(f['mean'])} mA"
    return f"{_SAID[f['controller']]}, but its mean amplitude{of} is {share}. Correct one of them."


def _silent_control(f: Mapping[str, Any]) -> str:
    return (
        f"The controlled {f['side']} had no stimulation, while the {' and the '.join(f['others'])} had: mean amplitude and energy "
        "are those of the controlled side alone. Correct the hemisphere if the other one counts."
    )


def _repeated(f: Mapping[str, Any]) -> str:
    other = f"session {f['session']} (recording {f['recording']}{', which counts' if f['counts'] else ''})"
    return (
        f"The same {f['seconds']:.0f} s of this device stand in {other}, and what recording {f['own']} holds of them is not the same: "
        "the same minutes count once. Look at both, and drop or exclude one."
    )


def _logged_policy(f: Mapping[str, Any]) -> str:
    if f["logged"] is None:
        return (
            f"The controller's log was written by a policy (number {f['number']} where its bundle was made) that is none of this "
            "participant's. Check that this is the participant's log."
        )
    return f"The controller's log was written by policy {f['logged']}, which is not what is stated for this session. Correct one of them."


def _logged_cdbs(f: Mapping[str, Any]) -> str:
    return (
        f"The controller ran with a cDBS amplitude of {f['logged']:g} mA, and the one in force here is {f['in_force']:g} mA: fractions are "
        "of the latter. Correct the visit's cDBS amplitude if it is wrong."
    )


def _logged_slot(f: Mapping[str, Any]) -> str:
    return (
        f"The controller's log is of session {f['position']} of the plan of visit {f['visit']} ({f['visit_date']}), and this session "
        f"stands in visit {f['other_visit']}. Correct the visit if it is wrong."
    )


def _no_slot(f: Mapping[str, Any]) -> str:
    return (
        f"The controller's log names session {f['position']} of plan {f['plan']}, visit {f['visit']} ({f['visit_date']}), which is no "
        "signed plan of this participant here any more. Check that this is the participant's log of that day."
    )


def share_decided(share: float) -> str:
    """Say how often a session's policy or schedule decided."""
    return f"its controller decided in {100 * share:.0f} % of the periods, cDBS stood in for the rest"


def seldom_decided(share: float, least: float) -> str:
    """Say why a session counts for no controller."""
    return f"{share_decided(share)}; below {100 * least:.0f} % a session counts for no controller"


def excluded_as_seldom_decided(session_id: int, why: str) -> str:
    """Report that a session was excluded for it."""
    return f"Session {session_id} is excluded: {why}."


_SENTENCES: dict[Kind, Callable[[Mapping[str, Any]], str]] = {
    Kind.DAY: _day,
    Kind.START: _start,
    Kind.FUTURE: lambda f: (
        f"Starts at {f['begins']:%Y-%m-%d %H:%M} UTC, which is in the future: it is {f['now']:%Y-%m-%d %H:%M} UTC. Correct the start, "
        "or the clock of the recording."
    ),
    Kind.SIDE: _side,
    Kind.UNREADABLE: lambda f: f"{f['detail']} {f['hint']}".strip(),
    Kind.LOGGED_SLOT: _logged_slot,
    Kind.NO_SLOT: _no_slot,
    Kind.BENCH: lambda f: (
        "The controller's log is of a trial on a bench, at which no participant was connected: it is no session. Drop it."
    ),
    Kind.SIMULATED: lambda f: (
        "The controller's log is of a simulated device: nobody was stimulated. It counts for synthetic participants alone. Drop it."
    ),
    Kind.ABOVE_CDBS: _above_cdbs,
    Kind.AMPLITUDE: _amplitude,
    Kind.SILENT_CONTROL: _silent_control,
    Kind.REPEATED: _repeated,
    Kind.AMPLITUDE_SOURCES: lambda f: (
        f"{' and '.join(f['names'])} state different amplitudes in {stated(f['seconds'], 3)} s of it: the amplitude is unknown there until "
        "a person chooses one of them, or 'unknown'."
    ),
    Kind.UNKNOWN_CLOCK: lambda f: (
        f"The start is on a clock whose offset from UTC is unknown (recording {f['recording']}): it may be hours off, and nothing of a "
        "watch or of another device is joined to it. State the offset if you know it."
    ),
    Kind.LOGGED_POLICY: _logged_policy,
    Kind.SEVERAL_PROGRAMS: lambda f: (
        f"The amplitude of {' and of '.join(f['others'])} moved as well as that of {f['counted']}, which is taken for the controller's: "
        "learning sees that one alone, energy all of them. Correct the program if the controller set another one."
    ),
    Kind.LOGGED_CDBS: _logged_cdbs,
    Kind.LAST_DOSE: lambda f: (
        f"The last dose is said to have been {stated(f['stated'], 3)} h before the start, which counts; by the visit's doses it was "
        f"{stated(f['by_doses'], 3)} h. Correct one of them."
    ),
    Kind.NO_POLICY: lambda f: (
        "No policy is named for this session: it cannot be compared with its estimate. Name one on the session's page."
    ),
}
