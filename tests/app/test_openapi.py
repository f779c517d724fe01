"""The REST interface against the one that was released: every difference is intended, and CHANGELOG names it."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[2]
RELEASED = ROOT / "tests" / "data" / "openapi-0.1.0.json"

INTENDED: dict[str, str] = {
    # "place, or the beginning of several": "reason, a sentence that stands in CHANGELOG.md word for word"
    **dict.fromkeys(
        (
            "components > schemas > AccuracyOut",
            "components > schemas > FiveMetricsOut",
            "components > schemas > MethodMetricOut",
            "components > schemas > MetricOut",
            "components > schemas > app__analysis__schemas__MetricOut",
            "components > schemas > app__evaluation__calibration_schemas__MetricOut",
        ),
        "The two schemas `MetricOut` of the OpenAPI document have names without module paths: `MetricOut` and `MethodMetricOut`.",
    ),
    **dict.fromkeys(
        (
            "components > schemas > CdbsAmplitudeModel",
            "components > schemas > CdbsAmplitudeOut",
            "components > schemas > SettingsIn",
            "components > schemas > SettingsOut",
            "components > schemas > VisitOut > properties > cdbs_amplitudes",
        ),
        "Settings and cDBS amplitudes have clinical bounds",
    ),
    **dict.fromkeys(
        (
            "components > schemas > BaselineScoreOut",
            "components > schemas > SweepOut",
            "components > schemas > YardstickOut",
        ),
        "API: sweeps call their scores of controllers without learning `baselines` (was `yardsticks`).",
    ),
    "components > schemas > ParticipantIn > properties > is_study_code": (
        "API: a study code that may be a name or holds a year or date of birth is questioned (422, `questions`)"
    ),
    **dict.fromkeys(
        (
            "components > schemas > SweepCandidateOut > properties > gain_method",
            "components > schemas > SweepCandidateOut > properties > supported",
            "components > schemas > SweepCandidateOut > required",
        ),
        "API: `gain_method` and `supported` of a sweep's policies",
    ),
    "paths > /readyz": "`GET /readyz` says whether requests can be served (the database answers and has this version's schema).",
    **dict.fromkeys(
        ("components > schemas > Problem", "components > schemas > ProblemOut"),
        "API: the member `mend` of problem documents and of file reports is called `hint`.",
    ),
    **dict.fromkeys(
        (
            "components > schemas > ChoiceOut",
            "components > schemas > CoverageOut",
            "components > schemas > EstimateOut",
            "components > schemas > FlagOut",
            "components > schemas > PlanEstimateOut",
            "components > schemas > RankedPolicy",
            "components > schemas > ReasonOut",
        ),
        "flags of estimates, rankings, plans and of what the data cover are objects `{code, value, limit, unit, text}`",
    ),
    **dict.fromkeys(
        (
            "components > schemas > EvaluateJob > properties > methods",
            "components > schemas > PipelineJob > properties > methods",
            "paths > /api/v1/participants/{code}/ranking > get > parameters > query method",
        ),
        "Evaluation: further methods by name, `impulse` and `posterior`",
    ),
    **dict.fromkeys(
        (
            "components > schemas > ConditionsChange",
            "components > schemas > ConditionsOut",
            "components > schemas > DesignParameters",
            "components > schemas > HoldModel",
            "components > schemas > ProgramModel",
            "components > schemas > SnapshotSessionOut",
            "paths > /api/v1/sessions/{session_id}/conditions",
        ),
        "API: `GET` and `PUT /sessions/{id}/conditions` read and correct what a session ran under; a snapshot's session names the revision",
    ),
    **dict.fromkeys(
        (
            "components > schemas > HeldOutOut",
            "components > schemas > RankingOut > properties > choice",
            "components > schemas > SkillOut",
        ),
        "API: `choice` of a ranking is null",
    ),
    **dict.fromkeys(
        (
            "components > schemas > LimitIn",
            "components > schemas > OverrideIn",
            "components > schemas > PlanIn > properties > limits",
            "components > schemas > PlanIn > properties > overrides",
            "components > schemas > PlannedSessionOut",
        ),
        "API: a plan takes `overrides` for unsafe policies and `limits` for tests with care",
    ),
    **dict.fromkeys(
        (
            "components > schemas > Deviation",
            "components > schemas > SlotConfirmation",
            "components > schemas > SlotRowOut",
            "components > schemas > SlotsConfirmed",
            "components > schemas > VisitComparisonOut",
            "paths > /api/v1/visits/{visit_id}/slots",
            "paths > /api/v1/visits/{visit_id}/slots/confirm",
        ),
        "API: `GET /visits/{id}/slots` holds a visit's sessions against its signed plan",
    ),
    **dict.fromkeys(
        (
            "components > schemas > Code",
            "components > schemas > KeyOpening",
            "components > schemas > KeyOut",
            "components > schemas > Move",
            "components > schemas > Order",
            "components > schemas > PlanIn > properties > blinded",
            "components > schemas > PlanIn > properties > break_minutes",
            "components > schemas > PlanIn > properties > no_dbs_minutes",
            "components > schemas > PlanIn > properties > order",
            "components > schemas > PlanIn > properties > repeats",
            "components > schemas > PlanIn > properties > starts_at",
            "components > schemas > PlanOut > properties > block",
            "components > schemas > PlanOut > properties > key",
            "components > schemas > PlanOut > properties > order",
            "components > schemas > PlanOut > properties > starts_at",
            "components > schemas > PlanOut > properties > warnings",
            "components > schemas > PlanWarningOut",
            "components > schemas > Removal",
            "paths > /api/v1/visits/{visit_id}/plan/key",
            "paths > /api/v1/visits/{visit_id}/plan/moves",
            "paths > /api/v1/visits/{visit_id}/removal",
        ),
        "API: a plan takes `repeats`, `order`, `break_minutes`, `no_dbs_minutes`, `starts_at` and `blinded`; its warnings are objects",
    ),
    **dict.fromkeys(
        (
            "components > schemas > Approval",
            "components > schemas > PlanIn > properties > hemisphere",
            "components > schemas > PlanIn > properties > max_ma",
            "components > schemas > PlanIn > properties > min_ma",
            "components > schemas > PlanIn > properties > ramp_ma_per_s",
            "components > schemas > PlanOut > properties > signature",
            "components > schemas > PlanOut > properties > signature_state",
            "components > schemas > PlanOut > required",
            "components > schemas > SignatureOut",
            "paths > /api/v1/visits/{visit_id}/plan/approve",
        ),
        "API: a plan is approved by a signature",
    ),
    **dict.fromkeys(
        ("paths > /api/v1/bundle-withdrawals", "paths > /api/v1/visits/{visit_id}/plan/sessions/{position}/bundle"),
        "API: bundles for the sessions of a signed plan",
    ),
    **dict.fromkeys(
        (
            "components > schemas > MarginsChange",
            "components > schemas > MarginsIn",
            "components > schemas > MarginsOut",
            "paths > /api/v1/participants/{code}/margins",
        ),
        "API: margins against cDBS and the levels of verdicts are read and set at `/participants/{code}/margins`.",
    ),
    **dict.fromkeys(
        (
            "components > schemas > BoundOut",
            "components > schemas > PlannedDesignOut",
            "components > schemas > PlannedHoldOut",
            "components > schemas > PlannedSessionOut > properties > design",
            "components > schemas > PlannedSessionOut > required",
        ),
        "API: settings have `design`, `design_ladder` and `early_visits`, and a planned session has `design`.",
    ),
    **dict.fromkeys(
        ("components > schemas > RecordedTraceOut", "paths > /api/v1/sessions/{session_id}/traces"),
        "API: `GET /sessions/{id}/traces` gives every trace of a session's recordings, not the control trace alone.",
    ),
    **dict.fromkeys(
        ("components > schemas > SampleFormat", "paths > /api/v1/sessions/{session_id}/samples"),
        "API: `GET /sessions/{id}/samples` gives a session's samples with their times, and every trace, as one Parquet or NWB file",
    ),
    **dict.fromkeys(
        (
            "components > schemas > SignalChannelOut",
            "components > schemas > SignalOut",
            "components > schemas > SpectrogramOut",
            "paths > /api/v1/sessions/{session_id}/signal",
        ),
        "API: `GET /sessions/{id}/signal` gives raw samples between two times at a wanted resolution, and their spectrogram",
    ),
    **dict.fromkeys(
        (
            "components > schemas > NameChange",
            "components > schemas > SiteIn",
            "components > schemas > SiteOut",
            "components > schemas > StudyIn",
            "components > schemas > StudyOut",
            "paths > /api/v1/studies",
            "paths > /api/v1/studies/{study_code}",
            "paths > /api/v1/studies/{study_code}/sites",
            "paths > /api/v1/studies/{study_code}/sites/{site_code}",
        ),
        "API: studies and their sites are read, added and renamed at `/studies`;",
    ),
    **dict.fromkeys(
        ("components > schemas > StatusChange", "paths > /api/v1/participants/{code} > patch"),
        "API: `PATCH /participants/{code}` says that a participant has completed the study, has withdrawn, or takes part again",
    ),
    "components > schemas > ProposalChange": "API: `control_stream` and `control_channel` of a proposal can be corrected.",
    **dict.fromkeys(
        (
            "components > schemas > DeviceEventOut",
            "components > schemas > DeviceHistoryOut",
            "components > schemas > DeviceSpectrumOut",
            "components > schemas > TherapyGroupOut",
            "components > schemas > TherapyProgramOut",
            "components > schemas > TrendOut",
            "paths > /api/v1/participants/{code}/device-history",
        ),
        "API: `GET /participants/{code}/device-history` gives what Percept reports tell of the device's own history",
    ),
    **dict.fromkeys(
        (
            "components > schemas > MappedColumnIn",
            "components > schemas > MappedOut",
            "components > schemas > MappingIn",
            "components > schemas > MappingOut",
            "components > schemas > PreviewLineOut",
            "components > schemas > PreviewOut",
            "components > schemas > RemovalIn",
            "components > schemas > UploadedFileOut > properties > waits_for_mapping",
            "components > schemas > UploadedFileOut > required",
            "paths > /api/v1/column-mappings/{mapping_id}/removal",
            "paths > /api/v1/studies/{study_code}/column-mappings",
            "paths > /api/v1/uploaded-files/{file_id}/mapping",
            "paths > /api/v1/uploaded-files/{file_id}/preview",
        ),
        "API: a table of unknown columns is no dead end: `GET /uploaded-files/{file_id}/preview` shows its first lines",
    ),
    "components > schemas > ProposalOut": "API: a proposal has `usable_steps`.",
    "components > schemas > UsableStepsOut": "API: a proposal has `usable_steps`.",
    "components > schemas > JobOut > properties > seconds_left": "API: a job has `seconds_left`.",
    "components > schemas > JobOut > required": "API: a job has `seconds_left`.",
    **dict.fromkeys(
        (
            "components > schemas > AssociationOut",
            "components > schemas > AverageOut",
            "components > schemas > BiomarkerOut",
            "components > schemas > BySeedOut",
            "components > schemas > EnergyOut",
            "components > schemas > MarginsLockedOut",
            "components > schemas > MeasureOut",
            "components > schemas > MissingValueOut",
            "components > schemas > OfParticipantOut",
            "components > schemas > OutcomeVerdictOut",
            "components > schemas > PairingOut",
            "components > schemas > ParticipantVerdictsOut",
            "components > schemas > PolicyMetricOut",
            "components > schemas > PooledMetricOut",
            "components > schemas > PooledOut",
            "components > schemas > PrimaryComparisonOut",
            "components > schemas > PrimaryOut",
            "components > schemas > SeedRowOut",
            "components > schemas > SensitivityOut",
            "components > schemas > StepTimeOut",
            "components > schemas > SummaryOut",
            "components > schemas > TestedOut",
            "components > schemas > TimeTestedOut",
            "components > schemas > VerdictOut",
            "components > schemas > VisitRowOut",
            "paths > /api/v1/analyses",
            "paths > /api/v1/participants/{code}/analyses",
            "paths > /api/v1/participants/{code}/analyses/beta",
            "paths > /api/v1/participants/{code}/analyses/energy",
            "paths > /api/v1/participants/{code}/analyses/evaluations",
            "paths > /api/v1/participants/{code}/analyses/primary",
        ),
        "API: analyses within the visit (`analyses/primary`), of energy, of beta, of methods by seed, and of all participants "
        "(`/analyses`), as JSON, CSV and SVG",
    ),
    **dict.fromkeys(
        (
            "components > schemas > MarginsLockIn",
            "components > schemas > MarginsLockOut",
            "components > schemas > VisitLockIn",
            "components > schemas > VisitLockOut",
            "paths > /api/v1/participants/{code}/margins/locks",
            "paths > /api/v1/visits/{visit_id}/lock",
            "paths > /api/v1/visits/{visit_id}/locks",
            "paths > /api/v1/visits/{visit_id}/unlock",
            "paths > /api/v1/visits/{visit_id} > patch > responses > 409",
            "paths > /api/v1/sessions/{session_id} > patch > responses > 409",
            "paths > /api/v1/sessions/{session_id}/qoc > put > responses > 409",
            "paths > /api/v1/sessions/{session_id}/outcomes > post > responses > 409",
            "paths > /api/v1/uploads > post > responses > 409",
        ),
        "API: visits and margins are locked with a reason; a locked visit takes no change (409)",
    ),
    **dict.fromkeys(
        ("components > schemas > SessionChange", "components > schemas > SessionOut"),
        "API: a session has `stopped_reason` and `medication_h`",
    ),
    **dict.fromkeys(
        (
            "components > schemas > Activity",
            "components > schemas > CharacteristicsChange",
            "components > schemas > CharacteristicsFields",
            "components > schemas > CharacteristicsOut",
            "components > schemas > DoseIn",
            "components > schemas > DoseOut",
            "components > schemas > DoseRemoval",
            "components > schemas > Drug",
            "components > schemas > Lead",
            "components > schemas > PlannedDose",
            "components > schemas > Symptom",
            "components > schemas > Target",
            "components > schemas > SnapshotOut > properties > characteristics_version",
            "components > schemas > SnapshotOut > required",
            "components > schemas > SnapshotSessionOut > properties > hours_since_dose",
            "paths > /api/v1/doses/{dose_id}/removal",
            "paths > /api/v1/participants/{code}/characteristics",
            "paths > /api/v1/visits/{visit_id}/doses",
        ),
        "API: characteristics of a participant are read and stated at `/participants/{code}/characteristics`",
    ),
    **dict.fromkeys(
        tuple(f"components > schemas > PipelineJob > properties > {name} > default" for name in ("aim", "algorithms", "anchor")),
        "The pipeline trains one default sweep from the page's button, the form, the API and the command line",
    ),
    **dict.fromkeys(
        (
            "components > schemas > NextGenerationJob",
            "paths > /api/v1/participants/{code}/jobs > post",
        ),
        "API: a job of kind `next_generation` goes on from the policies that did best in their sessions",
    ),
    **dict.fromkeys(
        (
            "components > schemas > AskedOut",
            "components > schemas > DifferenceOut",
            "components > schemas > ReplayOut",
            "paths > /api/v1/participants/{code}/replay",
        ),
        "API: `GET /participants/{code}/replay?session=&policy=` tells what policies would have asked for on a recorded session's beta",
    ),
    **dict.fromkeys(
        (
            "components > schemas > AdverseEventChange",
            "components > schemas > AdverseEventIn",
            "components > schemas > AdverseEventOut",
            "components > schemas > ClearanceIn",
            "components > schemas > EventKind",
            "components > schemas > Severity",
            "paths > /api/v1/adverse-events/{event_id}",
            "paths > /api/v1/adverse-events/{event_id}/clearance",
            "paths > /api/v1/participants/{code}/adverse-events",
        ),
        "API: adverse events are written down, corrected and cleared at `/participants/{code}/adverse-events` and `/adverse-events/{id}`",
    ),
    **dict.fromkeys(
        (
            "components > schemas > DataQueryEntryIn",
            "components > schemas > DataQueryEntryOut",
            "components > schemas > DataQueryIn",
            "components > schemas > DataQueryOut",
            "components > schemas > QueriedField",
            "components > schemas > QueryState",
            "paths > /api/v1/data-queries/{query_id}/entries",
            "paths > /api/v1/participants/{code}/data-queries",
        ),
        "API: data queries about a session's value or an upload are asked, answered, closed and asked again",
    ),
    **dict.fromkeys(
        (
            "components > schemas > AdverseEventEntry",
            "components > schemas > AdverseEventPayload",
            "components > schemas > ClinicalSettingsEntry",
            "components > schemas > DayOut",
            "components > schemas > EntriesIn",
            "components > schemas > EntriesOut",
            "components > schemas > EntryOut",
            "components > schemas > EntryResult",
            "components > schemas > GradeEntry",
            "components > schemas > GradePayload",
            "components > schemas > GraspEntry",
            "components > schemas > GraspPayload",
            "components > schemas > LimitsOut",
            "components > schemas > Mark",
            "components > schemas > NoteEntry",
            "components > schemas > NotePayload",
            "components > schemas > Nothing",
            "components > schemas > Page_EntryOut_",
            "components > schemas > RatingEntry",
            "components > schemas > RatingPayload",
            "components > schemas > ReasonEntry",
            "components > schemas > ReasonPayload",
            "components > schemas > SlotOut",
            "components > schemas > StopCauseEntry",
            "components > schemas > StopCausePayload",
            "paths > /api/v1/visits/{visit_id}/day",
            "paths > /api/v1/visits/{visit_id}/day/entries",
        ),
        "API: the clinic day of a visit at `/visits/{id}/day`, its entries at `/visits/{id}/day/entries`",
    ),
}


def differences(old: Any, new: Any, place: tuple[str, ...] = ()) -> Iterator[tuple[str, str]]:
    """(place, what) of every difference; the words of descriptions are no part of the contract."""
    if isinstance(old, dict) and isinstance(new, dict):
        for key in sorted(old.keys() | new.keys()):
            if key in ("description", "summary") and isinstance(old.get(key, new.get(key)), str):
                continue
            if key not in new:
                yield " > ".join((*place, key)), "is gone"
            elif key not in old:
                yield " > ".join((*place, key)), "is new"
            else:
                yield from differences(old[key], new[key], (*place, key))
    elif isinstance(old, list) and isinstance(new, list) and all(isinstance(v, dict) and "name" in v for v in old + new):
        # parameters: their order says nothing
        yield from differences({f"{v['in']} {v['name']}": v for v in old}, {f"{v['in']} {v['name']}": v for v in new}, place)
    elif isinstance(old, list) and isinstance(new, list) and any(isinstance(v, dict) for v in old + new) and len(old) == len(new):
        # alternatives: their order says nothing either
        for i, (a, b) in enumerate(zip(*(sorted(v, key=lambda one: json.dumps(one, sort_keys=True)) for v in (old, new)), strict=True)):
            yield from differences(a, b, (*place, str(i)))
    elif sorted(old, key=repr) != sorted(new, key=repr) if isinstance(old, list) and isinstance(new, list) else old != new:
        yield " > ".join(place), f"was {json.dumps(old)}, is {json.dumps(new)}"


def compared(old: dict[str, Any], new: dict[str, Any]) -> dict[str, str]:
    """Differences of two documents by place; the version of the service is allowed to move."""
    return dict(differences({k: v for k, v in old.items() if k != "info"}, {k: v for k, v in new.items() if k != "info"}))


def covers(beginning: str, place: str) -> bool:
    """Whether a line of the table is about a place."""
    return place == beginning or place.startswith(f"{beginning} > ")


def test_the_interface_is_the_released_one_but_for_what_is_intended(service_app: Any) -> None:
    found = compared(json.loads(RELEASED.read_text()), service_app.openapi())
    surprising = {place: what for place, what in found.items() if not any(covers(known, place) for known in INTENDED)}
    lines = "\n".join(f"  {place}: {what}" for place, what in surprising.items())
    assert not surprising, f"the REST interface has changed (list what is intended in INTENDED and in CHANGELOG.md):\n{lines}"
    stale = [known for known in INTENDED if not any(covers(known, place) for place in found)]
    assert stale == [], "these stand in INTENDED and do not differ"


def test_every_intended_difference_is_named_in_the_changelog() -> None:
    changelog = " ".join((ROOT / "CHANGELOG.md").read_text().split())
    assert [reason for reason in INTENDED.values() if not reason or " ".join(reason.split()) not in changelog] == []


def test_a_difference_of_each_kind_is_seen_at_its_place() -> None:
    released = json.loads(RELEASED.read_text())
    changed = json.loads(RELEASED.read_text())
    assert compared(released, changed) == {}
    del changed["paths"]["/api/v1/bundle-key"]
    changed["paths"]["/api/v1/sessions/{session_id}"]["delete"] = {}
    operation = changed["paths"]["/api/v1/participants/{code}"]["get"]
    operation["description"] = "Other words."
    operation["parameters"][0]["required"] = False
    operation["responses"]["200"]["content"]["application/json"]["schema"]["$ref"] = "#/components/schemas/Other"
    fields = changed["components"]["schemas"]["QocIn"]["properties"]
    fields["rating"]["anyOf"][0]["maximum"] = 5
    changed["components"]["schemas"]["ParticipantIn"]["required"] = []
    assert set(compared(released, changed)) == {
        "paths > /api/v1/bundle-key",
        "paths > /api/v1/sessions/{session_id} > delete",
        "paths > /api/v1/participants/{code} > get > parameters > path code > required",
        "paths > /api/v1/participants/{code} > get > responses > 200 > content > application/json > schema > $ref",
        "components > schemas > QocIn > properties > rating > anyOf > 0 > maximum",
        "components > schemas > ParticipantIn > required",
    }
