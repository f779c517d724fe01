"""Sentences of the study, made where somebody reads them; nothing is decided by them."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from typing import Any

from app.platform.web.numbers import stated
from app.study.characteristics.schemas import CharacteristicsFields, Symptom, Target
from app.study.doses.drugs import DRUGS
from app.study.enrolment.codes import CodeQuestion
from app.study.sessions.contradictions import Contradiction, Kind
from app.study.sessions.designs import Drawn
from app.study.settings.form import LABELS as SETTING_LABELS
from app.study.usual.values import Question, Why
from app.tables.adverse_events import EventKind, Severity
from app.tables.sessions import Activity, Controller
from app.tables.visits import Dose, Drug
from ml.outcomes import BY_FIELD, OUTCOMES

EVENT_KINDS = {
    EventKind.DYSKINESIA: "Dyskinesia",
    EventKind.SPEECH: "Speech",
    EventKind.GAIT: "Gait or balance",
    EventKind.FALL: "Fall",
    EventKind.MUSCLE_CONTRACTION: "Muscle contraction",
    EventKind.PARAESTHESIA: "Paraesthesia",
    EventKind.VISION: "Vision",
    EventKind.MOOD: "Mood",
    EventKind.COGNITION: "Thinking or confusion",
    EventKind.PAIN: "Pain",
    EventKind.NAUSEA: "Nausea",
    EventKind.DEVICE: "Device",
    EventKind.STOPPED: "Session stopped for the participant's sake",
    EventKind.OTHER: "Other",
}
EVENT_SEVERITIES = {Severity.NONE: "none", Severity.MILD: "mild", Severity.SEVERE: "severe", Severity.NOT_STATED: "not stated"}

DRUG_NAMES = {drug.value: facts.name for drug, facts in DRUGS.items()}
SYMPTOMS = {
    Symptom.TREMOR: "Tremor",
    Symptom.BRADYKINESIA: "Bradykinesia",
    Symptom.RIGIDITY: "Rigidity",
    Symptom.GAIT: "Gait",
    Symptom.DYSKINESIA: "Dyskinesia",
    Symptom.DYSTONIA: "Dystonia",
    Symptom.SPEECH: "Speech",
}
TARGETS = {Target.STN: "STN", Target.GPI: "GPi", Target.GPE: "GPe", Target.VIM: "Vim", Target.OTHER: "other"}
MEDICATION = "Medication of a visit day"
ACTIVITIES = {
    Activity.REST: "sat or lay",
    Activity.LIGHT: "walked, talked",
    Activity.EXERCISE: "exercised",
    Activity.MEAL: "ate",
    Activity.SLEEP: "slept",
}

UNUSUAL = "Some values are unusual: are they right?"
UNUSUAL_HINT = "Correct them, or say that they are right; nothing was saved yet."


def unusual(asked: Question) -> str:
    """What is asked about one value."""
    value = f"{stated(asked.value, 4)} {asked.unit}".strip()
    usual = f"{asked.low:g} to {asked.high:g} {asked.unit}".strip()
    match asked.code:
        case Why.SHARE:
            return f"{value}: less than one per cent. Was it meant as a share, {stated(100 * asked.value, 3)} %?"
        case Why.FAR_FROM_VISIT:
            return f"{value}, where the other sessions of this visit have {usual}: {_ends(asked.field)}. Is it right?"
        case Why.BELOW:
            return f"{value} is below what is usual ({usual}). Is it right?"
        case Why.ABOVE:
            return f"{value} is above what is usual ({usual}). Is it right?"


def _ends(field: str) -> str:
    """Which end of an outcome's scale is the worst, and which the best."""
    outcome = BY_FIELD[field]
    best = outcome.high if outcome.higher_is_better else outcome.low
    return f"{outcome.worst_possible:g} is worst, {best:g} is best"


CODE_QUESTIONS = {
    CodeQuestion.NAME: "it holds a word that may be a name",
    CodeQuestion.BIRTH_YEAR: "it holds a year in which a participant may have been born",
    CodeQuestion.BIRTH_DATE: "it holds a date on which a participant may have been born",
}
CODE_HINT = "Choose a code that tells nothing about the person, or confirm that this is a study code."
CODE_CONFIRMED = "looked at by a person: a study code"

QUERIED_FIELDS = {
    **{o.field: o.label for o in OUTCOMES},
    "controller": "Controller",
    "started_at": "Start",
    "hemisphere": "Hemisphere",
    "medication_h": "Time since the last dose",
    "stopped_reason": "Early stop",
    "file": "Uploaded file",
    "date": "Date",
    "cdbs_left": "cDBS amplitude, left",
    "cdbs_right": "cDBS amplitude, right",
    "note": "Note",
    "drug": "Drug",
    "mg": "Dose",
    "taken_at": "Time it was taken",
    "kind": "What happened",
    "severity": "Severity",
    "serious": "Whether it is serious",
    "occurred_at": "When it happened",
    "leads": "Leads",
    "symptoms": "Symptoms",
    "hand": "Hand of the grasp test",
    "medication": "Medication of a visit day",
    **SETTING_LABELS,
    "other": "Something else",
}
"""Values that a data query may be about, by the name of their field."""
ASKED_ABOUT = {name: said[:1].lower() + said[1:] if said[:2] not in ("cD", "r_") else said for name, said in QUERIED_FIELDS.items()}
"""The same within a sentence."""

_SAID = {Controller.CDBS: "Said to be cDBS", Controller.NO_DBS: "Said to be without DBS"}


def characteristics_words(known: CharacteristicsFields) -> dict[str, str]:
    """Characteristics in words, by label; empty where nothing is stated."""
    leads = "; ".join(
        f"{lead.hemisphere} {TARGETS[lead.target]}"
        + (f", {lead.model}" if lead.model else "")
        + (f", sensing {lead.sensing}" if lead.sensing else "")
        + (f", stimulating {lead.stimulating}" if lead.stimulating else "")
        for lead in known.leads
    )
    medication = "; ".join(f"{d.at} {DRUGS[d.drug].name} {d.mg:g} mg" for d in known.medication)
    symptoms = ", ".join(SYMPTOMS[s].lower() for s in known.symptoms)
    return {"Leads": leads, "Symptoms": symptoms, "Hand of the grasp test": str(known.hand or ""), MEDICATION: medication}


def doses_words(doses: Iterable[Dose]) -> str:
    """Doses that were taken, by time."""
    return "; ".join(f"{d.taken_at:%Y-%m-%d %H:%M} {DRUGS[Drug(d.drug)].name} {d.mg:g} mg" for d in doses)


def code_questions(code: str, found: Iterable[CodeQuestion]) -> str:
    """What a study code looks like."""
    return f"The code '{code}' may tell who the participant is: {' and '.join(CODE_QUESTIONS[q] for q in found)}."


def sentences(contradictions: Iterable[Contradiction]) -> list[str]:
    """What a person should look at, a sentence each."""
    return [_SENTENCES[c.kind](c.facts) for c in contradictions]


def drawn_words(drawn: Drawn) -> str:
    """How a random session's amplitudes were drawn."""
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
    share = f"{100 * f['mean_fraction']:.0f} % of the cDBS amplitude" if f["mean_fraction"] is not None else f"{stated(f['mean'], 3)} mA"
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


_SENTENCES: dict[Kind, Callable[[Mapping[str, Any]], str]] = {
    Kind.DAY: _day,
    Kind.START: _start,
    Kind.SIDE: _side,
    Kind.UNREADABLE: lambda f: f"{f['detail']} {f['hint']}".strip(),
    Kind.LOGGED_SLOT: _logged_slot,
    Kind.NO_SLOT: _no_slot,
    Kind.BENCH: lambda f: (
        "The controller's log is of a trial on a bench, at which no participant was connected: it is no session. Drop it."
    ),
    Kind.SIMULATED: lambda f: (
        "The controller's log is of a simulated device: nobody was stimulated. It counts in a study of synthetic participants alone; "
        "of a real participant drop it."
    ),
    Kind.ABOVE_CDBS: _above_cdbs,
    Kind.AMPLITUDE: _amplitude,
    Kind.SILENT_CONTROL: _silent_control,
    Kind.REPEATED: _repeated,
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
