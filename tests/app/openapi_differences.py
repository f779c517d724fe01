"""Where the REST interface differs from the released one on purpose: place, and the sentence of CHANGELOG that says it."""

from __future__ import annotations

from tests.openapi_everywhere import EVERYWHERE
from tests.openapi_new_features import NEW_FEATURES

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
    "components > schemas > ParticipantIn > properties > site": "API: `site` of an enrolment takes `STUDY/SITE`",
    **dict.fromkeys(
        (
            "components > schemas > SweepCandidateOut > properties > gain_method",
            "components > schemas > SweepCandidateOut > properties > supported",
            "components > schemas > SweepCandidateOut > required",
        ),
        "API: `gain_method` and `supported` of a sweep's policies",
    ),
    **dict.fromkeys(
        (
            "components > schemas > ParticipantIn > properties > sure",
            "components > schemas > QocIn > properties > sure",
            "components > schemas > SettingsChange > properties > sure",
        ),
        "API: QoCs and cDBS amplitudes outside the usual are questioned (422, `questions`)",
    ),
    **dict.fromkeys(
        (
            "components > schemas > VisitOfRecordingIn",
            "components > schemas > VisitOfRecordingOut",
            "paths > /api/v1/proposals/{session_id}/visit",
        ),
        "API: `POST /proposals/{id}/visit` adds a visit on the day of a recording",
    ),
    **dict.fromkeys(
        (
            "paths > /api/v1/participants/{code}/policies > post > responses > 429",
            "paths > /api/v1/uploads > post > responses > 429",
        ),
        "API: limits by source: failed sign-ins of a network address, and files of an address and of a user within an hour",
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
            "components > schemas > PlanOut > properties > seed",
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
        (
            "components > schemas > PolicyReleaseIn",
            "components > schemas > PolicyReleaseLimits",
            "components > schemas > PolicyReleaseOut",
            "components > schemas > SignatureState",
            "paths > /api/v1/policies/{policy_id}/release",
        ),
        "API: policies are released for testing by a signature",
    ),
    "paths > /api/v1/policies/{policy_id}/bundle > get > responses > 409": "a policy's bundle may be refused with 409.",
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
        ("components > schemas > HeldIn", "components > schemas > PlanIn > properties > held"),
        "API: a plan's `held` asks for sessions held near an amplitude (design `near`).",
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
            "components > schemas > MarginsLockIn",
            "components > schemas > MarginsLockOut",
            "components > schemas > VisitLockIn",
            "components > schemas > VisitLockOut",
            "components > schemas > VisitUnlockIn",
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
        tuple(f"components > schemas > {job} > properties > again" for job in ("DistillJob", "EvaluateJob", "PipelineJob", "TrainJob")),
        "API: a request for a job that is sent twice starts one",
    ),
    **dict.fromkeys(
        tuple(f"components > schemas > {job} > properties > critic_memory" for job in ("PipelineJob", "TrainJob")),
        "Critics may remember past amplitudes (`critic_memory`)",
    ),
    **dict.fromkeys(
        tuple(f"components > schemas > PipelineJob > properties > {name} > default" for name in ("aim", "algorithms", "anchor")),
        "The pipeline trains one default sweep from the page's button, the form, the API and the command line",
    ),
    "components > schemas > SweepCandidateOut > properties > beyond_margin": "(API: `beyond_margin`)",
    **dict.fromkeys(
        tuple(f"components > schemas > SweepCandidateOut > properties > {name}" for name in ("energy_saved", "within_margins")),
        "(API: `energy_saved`, `within_margins`)",
    ),
    **dict.fromkeys(
        tuple(f"components > schemas > {job} > properties > anchor" for job in ("PipelineJob", "TrainJob")),
        "Policies may be held near the best constant amplitude",
    ),
    **dict.fromkeys(
        ("components > schemas > DayDoseOut", "components > schemas > DoseEntry", "components > schemas > DosePayload"),
        "API: a dose is an entry of the clinic day (kind `dose`; migration 0029)",
    ),
    **NEW_FEATURES,
    **EVERYWHERE,
}
