"""The dictionary of the data package: every column of every table, and the descriptor that Frictionless defines (datapackage.json)."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import date, datetime
from typing import Any

from app import __version__
from ml.outcomes import ANY, OUTCOMES


@dataclass(frozen=True)
class Field:
    """One column; `kind` is a type of Frictionless Table Schema."""

    name: str
    kind: str
    text: str


class Days:
    """Times as days since the participant was enrolled, so that no date leaves."""

    def __init__(self, enrolled: datetime) -> None:
        self._enrolled = enrolled

    def of(self, moment: datetime | None) -> float | None:
        """Convert a moment to days since enrolment; None where it is not known."""
        return None if moment is None else round((moment - self._enrolled).total_seconds() / 86400, 5)

    def of_date(self, day: date | None) -> int | None:
        """Convert a date to whole days since enrolment."""
        return None if day is None else (day - self._enrolled.date()).days


_INDENT = "\n        "
_VALUES = _INDENT.join(f"{o.column} {'integer' if o.whole else 'number'} {o.exported}" for o in OUTCOMES)
_MARGINS = _INDENT.join(f"{o.margin.field} number {o.margin.description}" for o in OUTCOMES)

TITLES = {
    "sessions": "one row per confirmed session",
    "steps": "beta and amplitude on the 2 s grid of every session",
    "visits": "visit days, and whether their data are locked",
    "policies": "every policy of the participant",
    "estimates": "every estimate of a return, with its interval",
    "coverage": "what the data could say about each policy, checked before it was estimated",
    "outcomes": "what outcomes are called, which way is better, and how they are compared",
    "adverse_events": "every adverse event as it is known now",
    "doses": "medication taken at each visit; times since a dose count those of drugs whose effect comes and goes within hours",
    "margins": "versions of the non-inferiority margins, and when they were locked",
    "primary": "controllers and policies against the same visit's cDBS; recompute.py checks those of controllers",
    "noninferiority": "outcomes of the verdicts; recompute.py checks them",
}


def _fields(text: str) -> tuple[Field, ...]:
    """Parse `name type meaning`, a line each."""
    return tuple(Field(*line.strip().split(" ", 2)) for line in text.strip().splitlines())


FIELDS: dict[str, tuple[Field, ...]] = {
    "sessions": _fields(f"""
        session_id integer Number of the session.
        visit integer Number of the visit.
        ordinal integer Place in the visit.
        controller string cdbs, rl, distilled, no_dbs, random or other.
        policy_id integer Policy that ran, in policies.csv.
        hemisphere string Controlled side.
        started_day number Start, days since enrolment.
        recorded_day number When its record was made, days since enrolment.
        duration_s number Length, s.
        beta_unit string Unit of beta.
        beta_source string Where beta comes from; sources are never mixed.
        beta_compared boolean Whether its mean beta is of the unit and source that are compared.
        cdbs_amplitude_ma number cDBS amplitude in force, mA.
        steps_above_cdbs integer Steps above the cDBS amplitude.
        excluded_reason string Why somebody excluded it; such a session counts in no analysis.
        stopped_reason string Why it was stopped for the patient's sake; a failure of its controller.
        policy_share number Share of its decisions that followed policy or schedule, by the tablet's log; empty without one.
        hours_since_dose number Hours from the last dose to its start, as stated, else by doses.csv.
        activity string What the participant did in the half hour before: rest, light, exercise, meal or sleep.
        {_VALUES}
        qoc_revision integer Revision of these QoCs.
        problem string Why it has no steps; such a session counts in no analysis.
    """),
    "adverse_events": _fields("""
        event_id integer Number of the event.
        revision integer Revision of what is known.
        visit integer Number of the visit; empty apart from visits.
        session_id integer Session, if it happened in one.
        policy_id integer Policy that ran, in policies.csv; empty where it is hidden or none did.
        kind string What happened; empty where nothing was found.
        severity string none, mild, moderate, severe or not_stated.
        serious boolean Whether it is serious (ISO 14155).
        began_day number Days since enrolment.
        ended_day number Days since enrolment; empty where it has not ended, or that is not known.
        relation string To what was tested; empty: not judged.
        action string Taken because of it; empty: not stated.
        outcome string Its outcome; empty: not known.
        cleared boolean Whether a clinician cleared it; what ran then counts as safe again.
    """),
    "steps": _fields("""
        session_id integer Number of the session.
        t_s number End of the window after the session's start, s; 0 or less: before it.
        beta number Beta amplitude of the window, in the session's beta_unit; empty where invalid.
        amplitude_ma number Amplitude in force over the window, mA; empty where unknown.
        amplitude_fraction number The same as a share of the cDBS amplitude; may exceed 1.
    """),
    "visits": _fields("""
        visit integer Number of the visit.
        day integer Days since enrolment.
        locked boolean Whether its data are closed for changes.
        sessions integer Sessions, proposals included.
    """),
    "policies": _fields("""
        policy_id integer Number of the policy.
        name string Its name.
        kind string trained, distilled, external or a reference.
        algorithm string How it was made.
        teacher_id integer Policy that it was distilled from.
        snapshot_id integer Buffer snapshot that it was trained on.
        seed integer Seed of its training.
        created_day number Days since enrolment.
        onnx_sha256 string Hash of its file.
        standing string Harms, own sessions and prediction, in the words of every page; empty where there is nothing of these.
    """),
    "estimates": _fields("""
        evaluation_id integer Number of the evaluation.
        snapshot_id integer Buffer snapshot that it rests on.
        settings_version_id integer Settings that it rests on.
        horizon_steps integer H, steps.
        gamma number Discount per step.
        policy_id integer Policy.
        method string Method of evaluation.
        value number Estimate of E[r_end + sum over t < H of gamma^t r_t].
        low number Lower end of its interval.
        high number Upper end of its interval.
        level number Coverage of the interval.
        supported boolean Whether the data can say anything about this policy.
        flags string What to know about it.
    """),
    "coverage": _fields("""
        evaluation_id integer Number of the evaluation.
        policy_id integer Policy.
        supported boolean Whether all checks were passed.
        check string What was checked.
        value number What was found.
        limit number What it was held against.
        limit_is string least or greatest.
        verdict string Outcome of the check.
    """),
    "outcomes": _fields("""
        outcome string Name of the outcome in primary.csv and noninferiority.csv.
        column string Its column in sessions.csv.
        unit string Its unit.
        higher_is_better boolean Whether more is better.
        resolution number Step between neighbouring values; 0 where it is continuous.
        bounded boolean Whether sessions reach an end of its scale.
        ordinal boolean Whether pairs are compared, and no differences.
        failure number Value of a session that was stopped for the patient's sake; empty of the worst that any session measured.
    """),
    "doses": _fields("""
        visit integer Number of the visit.
        drug string What was taken.
        mg number Of the active drug, mg; of levodopa combinations the levodopa.
        levodopa_equivalent_mg number What it counts as, mg of levodopa; empty where no equivalent is stated.
        taken_day number When it was taken, days since enrolment.
    """),
    "margins": _fields(f"""
        version integer Version of the margins.
        {_MARGINS}
        created_day number Days since enrolment.
        locked_day number When this version was locked, days since enrolment; empty where it was not.
    """),
    "primary": _fields(f"""
        controller string Controller.
        policy_id integer Policy; empty for the controller with all its policies.
        name string Its name.
        role string planned (adjusted by Holm) or exploration (by Benjamini and Hochberg).
        basis string all, confirmation or selection: which sessions of a policy count.
        metric string energy (mean squared amplitude fraction), mean_beta, {ANY}.
        unit string Unit of the metric.
        estimate number Average over visits of the controller's mean less that of the same visit's cDBS.
        low number Lower end of its interval.
        high number Upper end of its interval.
        level number Coverage of the interval.
        p number Two-sided, on t with visits less 1 degrees of freedom.
        p_adjusted number Adjusted within its family.
        cliffs_delta number How much more often the controller's value is the higher one than the lower one, within visits.
        cliffs_delta_low number Lower end of its interval.
        cliffs_delta_high number Upper end of its interval.
        van_elteren_p number Exact test within visits.
        paper_p number Rank-sum test of all sessions, whatever their visit, as in the paper.
        visits integer Visits with both arms.
        sessions integer Sessions of the controller in them.
        cdbs_sessions integer Sessions of cDBS in them.
        adjustment string What the contrasts are freed from.
        not_available string Why there is no number.
    """),
    "noninferiority": _fields(f"""
        controller string Controller.
        confirmatory boolean Whether the margins were locked before every session that it rests on.
        margins_version integer Version of the margins that it goes by, in margins.csv.
        locked_day number When these margins were locked, days since enrolment; empty where nobody locked them.
        superseded_day number When a newer lock followed, days since enrolment; empty of the margins in force.
        outcome string {ANY}, in outcomes.csv.
        margin number Largest loss that is accepted, in the unit of the outcome.
        margin_share number The margin as a share of the value under cDBS; empty where it is none.
        estimate number Average over visits, turned so that higher is better; of ordinal ones the share of pairs won with the margin added.
        p_non_inferior number One-sided, of a loss of the margin or more.
        failures integer Sessions of the controller that were stopped for the patient's sake.
        visits string Visits whose sessions it rests on.
    """),
}


def descriptor(code: str, synthetic: bool, contents: Mapping[str, str]) -> dict[str, Any]:
    """Build datapackage.json of these tables, by Frictionless Data Package v1."""
    resources = []
    for name, fields in FIELDS.items():
        content = contents[f"{name}.csv"].encode()
        schema = {"fields": [{"name": f.name, "type": f.kind, "description": f.text} for f in fields], "missingValues": [""]}
        if name == "sessions":
            schema["primaryKey"] = "session_id"
        resources.append(
            {
                "name": name, "path": f"{name}.csv", "title": TITLES[name], "profile": "tabular-data-resource", "format": "csv",
                "mediatype": "text/csv", "encoding": "utf-8", "bytes": len(content),
                "hash": f"sha256:{hashlib.sha256(content).hexdigest()}", "schema": schema,
            }
        )  # fmt: skip
    return {
        "profile": "tabular-data-package",
        "name": f"betaloop-{code.lower()}",
        "title": f"Record of {'synthetic ' * synthetic}participant {code}",
        "synthetic": synthetic,
        "description": f"Made by betaloop {__version__}. Times are days since enrolment; names, dates and serial numbers are not in it.",
        "resources": resources,
    }
