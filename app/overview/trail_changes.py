"""Meaning of a row's change for a reader: each audited table has its sentence, without the actor, who is shown next to it."""

from __future__ import annotations

from collections.abc import Callable

from app.overview.trail_rows import Names, Row
from app.planning.visit_day.record import ASKED
from app.study.adverse_event_types import EVENT_KINDS
from app.study.data_queries import ASKED_ABOUT

_JOBS = {
    "evaluate": "evaluation", "train": "training", "distil": "distillation", "next_generation": "next-generation", "pipeline": "pipeline",
}  # fmt: skip
_ENTERED = {
    "start": "the start of", "stop": "the end of", "session_end": "the end of", "stop_cause": "why it was stopped early, of",
    **{one.kind: f"{one.one} of" for one in ASKED}, "dyskinesia": "dyskinesia in", "speech": "speech in", "gait": "gait in",
    "note": "a note on", "adverse_event": "an adverse event in", "skip": "the skipping of", "repeat": "the repeating of",
    "clinical_settings": "the clinical settings of", "dose": "a dose of the day of",
}  # fmt: skip
"""Kinds of entries of the clinic day, before the session or the day that they belong to."""


def with_article(words: str) -> str:
    """Put "a" or "an" before words."""
    sounds_open = words[:1].lower() in "aeiou" and not words.lower().startswith(("uni", "use", "one", "eu"))
    return f"{'an' if sounds_open else 'a'} {words}"


def _taken_back(before: Row, after: Row) -> bool:
    """Check whether a change marks a row as removed."""
    return bool(after.get("removed_at")) and not before.get("removed_at")


def _key(before: Row, after: Row, name: str) -> int | None:
    """Return a foreign key of a row; the one that it had before where what it named was deleted."""
    now: int | None = after.get(name)
    was: int | None = before.get(name)
    return was if now is None else now


def _left(before: Row, after: Row, name: str) -> bool:
    """Check whether what a row belonged to was deleted, and the row stays."""
    return bool(after) and after.get(name) is None and before.get(name) is not None


def _participant(before: Row, after: Row, _: Names) -> str:
    row = after or before
    if not before:
        return f"enrolled {row['code']}"
    said = {"withdrawn": "recorded that {} has withdrawn", "completed": "recorded that {} has completed the study"}
    if before.get("status") != row.get("status"):
        return said.get(str(row.get("status")), "recorded that {} takes part again").format(row["code"])
    return f"changed {row['code']}"


def _visit(before: Row, after: Row, names: Names) -> str:
    row = after or before
    verb = "removed" if not after else "changed" if before else "added"
    return f"{verb} visit {row['number']} of {names.participant(row['participant_id'])}"


def _session(before: Row, after: Row, names: Names) -> str:
    row = after or before
    which = names.session(row["id"], row)
    if not after:
        return f"dropped {which}"
    if not before:
        return f"proposed {which}" if row.get("status") == "proposed" else f"took in {which}"
    if before.get("status") == "proposed" and row.get("status") == "confirmed":
        return f"confirmed {which}"
    if bool(before.get("excluded_reason")) != bool(row.get("excluded_reason")):
        return f"excluded {which}" if row.get("excluded_reason") else f"included {which} again"
    return f"corrected {which}"


def _plan(before: Row, after: Row, names: Names) -> str:
    row = after or before
    which = f"plan {row['id']} for {names.visit(row['visit_id'])}"
    if not after:
        return f"discarded the draft of {which}"
    if not before:
        return f"drafted {which}"
    changed = {"approved": "approved", "superseded": "replaced"} if row["status"] != before["status"] else {}
    return f"{changed.get(row['status'], 'changed')} {which}"


def _policy(before: Row, after: Row, names: Names) -> str:
    row = after or before
    which = f"policy {row['name']} of {names.participant(row['participant_id'])}"
    if not before:
        return f"stored {which}"
    if bool(before.get("retired_reason")) != bool(row.get("retired_reason")):
        return f"retired {which}" if row.get("retired_reason") else f"took {which} back into use"
    return f"changed {which}"


def _job(before: Row, after: Row, names: Names) -> str:
    row = after or before
    job = f"{_JOBS.get(str(row['kind']), str(row['kind']).replace('_', ' '))} job"
    which = f"{with_article(job)} of {names.participant(row['participant_id'])}"
    if not before:
        return f"asked for {which}"
    if row.get("cancel_requested_at") and not before.get("cancel_requested_at"):
        return f"stopped {which}"
    ends = {"running": "began", "succeeded": "finished", "failed": "failed at", "cancelled": "stopped"}
    return f"{ends.get(str(row['status']), 'changed') if row['status'] != before['status'] else 'changed'} {which}"


def _account(before: Row, after: Row, _: Names) -> str:
    row = after or before
    if not before:
        return f"made the account {row['email']}"
    if before.get("active") != row.get("active"):
        return f"{'opened' if row.get('active') else 'closed'} the account {row['email']}"
    return f"changed the account {row['email']}"


def _version(of: str) -> Callable[[Row, Row, Names], str]:
    def said(before: Row, after: Row, names: Names) -> str:
        row = after or before
        verb = "set the first" if row["version"] == 1 else "changed the"
        return f"{verb} {of} of {names.participant(row['participant_id'])} (version {row['version']})"

    return said


def _dose(before: Row, after: Row, names: Names) -> str:
    row = after or before
    verb = "took back" if not after or after.get("removed_at") else "wrote down"
    return f"{verb} a dose of {str(row['drug']).replace('_', ' ')} at {names.visit(row['visit_id'])}"


def _of_session(first: str, later: str) -> Callable[[Row, Row, Names], str]:
    def said(before: Row, after: Row, names: Names) -> str:
        row = after or before
        return f"{first if row.get('revision', 1) == 1 else later} {names.session(row['session_id'])}"

    return said


def _decided(_before: Row, after: Row, names: Names) -> str:
    of = names.participant(after.get("participant_id"))
    return f"decided whether policies of {of} learn from sessions of earlier ones: {after.get('choice')}"


def _token(before: Row, after: Row, _: Names) -> str:
    row = after or before
    revoked = row.get("revoked_at") and not before.get("revoked_at")
    return f"{'revoked' if revoked else 'changed' if before else 'made'} the token \u201c{row['name']}\u201d"


def _upload(before: Row, after: Row, names: Names) -> str:
    row = after or before
    return f"{'went on with' if before else 'began'} upload {row['id']} of {names.participant(row.get('participant_id'))}"


def _file(before: Row, after: Row, _: Names) -> str:
    row = after or before
    if before and row.get("reviewed_at") != before.get("reviewed_at"):
        return f"looked at the original of file {row['id']} of upload {row['upload_id']}"
    if row.get("decided_at") and not before.get("decided_at"):
        return f"decided on file {row['id']} of upload {row['upload_id']}"
    return f"{'read' if before else 'received'} file {row['id']} of upload {row['upload_id']}"


def _column_mapping(before: Row, after: Row, names: Names) -> str:
    row = after or before
    return f"{'removed' if row.get('removed') else 'stated'} the column mapping '{row['name']}'"


def _signal_meaning(old_row: Row, new_row: Row, names: Names) -> str:
    row = new_row or old_row
    return f"{'removed' if row.get('removed') else 'stated'} the meaning of '{row['shown']}' in recordings"


def _membership(before: Row, after: Row, names: Names) -> str:
    row = after or before
    who, role = names.person(row["user_id"]), str(row["role"]).replace("_", " ")
    where = names.place(row["study_id"], row.get("site_id"))
    if not after:
        return f"took the role {role} from {who} in {where}"
    return f"{'changed' if before else 'gave'} {who} {'to ' if before else ''}the role {role} in {where}"


def _second_factor(before: Row, after: Row, names: Names) -> str:
    whose = names.person((after or before)["user_id"])
    if not after:
        return f"removed the second factor of {whose}"
    if not before:
        return f"began to set up the second factor of {whose}"
    confirmed = after.get("confirmed_at") and not before.get("confirmed_at")
    return f"{'set up' if confirmed else 'changed'} the second factor of {whose}"


def _sign_on_link(before: Row, after: Row, names: Names) -> str:
    whose = names.person((after or before)["user_id"])
    return f"linked the account {whose} to a sign-on" if after else f"unlinked the account {whose} from a sign-on"


def _place(kind: str) -> Callable[[Row, Row, Names], str]:
    def said(before: Row, after: Row, names: Names) -> str:
        row = after or before
        of = f" of study {names.studies.get(row['study_id'], row['study_id'])}" if "study_id" in row else ""
        verb = "removed" if not after else "changed" if before else "made"
        if before and bool(before.get("ended_at")) != bool(row.get("ended_at")):
            verb = "ended" if row.get("ended_at") else "opened again"
        return f"{verb} the {kind} {row['code']}{of}"

    return said


def _amplitude(before: Row, after: Row, names: Names) -> str:
    row = after or before
    side = f"{row['hemisphere']}, program {row['program']}" if row.get("program") else row["hemisphere"]
    of = f"the cDBS amplitude of {names.visit(_key(before, after, 'visit_id'))}"
    if not after:
        return f"removed {of} ({side})"
    if _taken_back(before, after):
        return f"took back {of}, {row['amplitude_ma']:g} mA ({side})"
    if _left(before, after, "visit_id"):
        return f"kept {of}, {row['amplitude_ma']:g} mA ({side}), which was taken back, without the visit"
    return f"{'changed' if before else 'set'} {of} to {row['amplitude_ma']:g} mA ({side})"


def _grasp_test(before: Row, after: Row, names: Names) -> str:
    of = f"a grasp test of {names.session(_key(before, after, 'session_id'))}"
    if _taken_back(before, after):
        return f"took back {of}"
    if _left(before, after, "session_id"):
        return f"kept {of}, which was taken back, without the session"
    return f"{'changed' if before else 'took in'} {of}"


def _tremor(before: Row, after: Row, names: Names) -> str:
    verb = "took back" if _taken_back(before, after) else "changed" if before else "took in"
    return f"{verb} tremor readings of {names.participant((after or before)['participant_id'])}"


def _adverse_event(before: Row, after: Row, names: Names) -> str:
    row = after or before
    return f"{'changed' if before else 'wrote down'} an adverse event of {names.at(row['participant_id'], row.get('visit_id'))}"


def _event_revision(_before: Row, after: Row, names: Names) -> str:
    kind = str(EVENT_KINDS.get(after["kind"], after["kind"])).lower()
    verb = "cleared" if after.get("cleared_reason") else "corrected" if after["revision"] > 1 else "wrote down"
    return f"{verb} an adverse event ({kind}) of {names.event(after['event_id'])}"


def about(row: Row, names: Names) -> str:
    """Describe the subject of a data query: a value in words, and its record."""
    field = str(row["field"])
    value = ASKED_ABOUT.get(field, field.replace("_", " "))
    whose = names.participant(row["participant_id"])
    if row.get("session_id") is not None:
        return f"{value} of {names.session(row['session_id'])}"
    if row.get("visit_id") is not None:
        return f"{value} of {names.visit(row['visit_id'])}"
    if row.get("event_id") is not None:
        return f"{value} of an adverse event of {names.event(row['event_id'])}"
    if row.get("record") is not None:
        return f"{value} in the {row['record']} of {whose}"
    if row.get("dose_id") is not None:
        return f"{value} of a dose of {whose}"
    return f"{value} of upload {row['upload_id']} of {whose}"


def _query(_before: Row, after: Row, names: Names) -> str:
    return f"asked a data query on {about(after, names)}"


def _query_entry(_before: Row, after: Row, names: Names) -> str:
    query = names.queries.get(after["query_id"])
    which = f"data query {after['query_id']}" + (f" on {about(query, names)}" if query else "")
    return f"{ {'open': 'asked', 'answered': 'answered', 'closed': 'closed'}.get(after['state'], 'changed') } {which}"


def _segment(before: Row, after: Row, names: Names) -> str:
    row = after or before
    verb = "took a part of a recording from" if not after else "changed the recordings of" if before else "gave a part of a recording to"
    return f"{verb} {names.session(row['session_id'])}"


def _recording(before: Row, after: Row, names: Names) -> str:
    row = after or before
    return f"{'changed' if before else 'took in'} a recording of {names.participant(row['participant_id'])}"


def _proposal(before: Row, after: Row, names: Names) -> str:
    which = names.session((after or before)["session_id"])
    return f"closed the proposal of {which}" if not after else f"{'changed' if before else 'made'} the proposal of {which}"


def _plan_item(before: Row, after: Row, names: Names) -> str:
    row = after or before
    verb = "removed" if not after else "moved" if before and before["position"] != after["position"] else "changed" if before else "planned"
    return f"{verb} session {row['position']} of {names.plan(row['plan_id'])}"


def _signature(_before: Row, after: Row, names: Names) -> str:
    number, kind = int(after["subject_id"]), str(after["subject_kind"])
    if kind == "plan":
        what = names.plan(number)
    elif kind == "policy":
        what = names.policy(number)
    elif kind == "visit_lock":
        what = f"the lock of {names.visit(names.locks.get(number))}"
    elif kind == "margins_lock":
        what = f"the margins of {names.participant(names.margins_locks.get(number))}"
    elif kind == "declared_confirmation":
        what = f"the confirmation of {names.policy(names.confirmations.get(number, 0))}"
    else:
        what = f"{kind.replace('_', ' ')} {number}"
    return f"signed {what}: {after['meaning']}"


def _day_entry(_before: Row, after: Row, names: Names) -> str:
    kind = _ENTERED.get(str(after["kind"]), str(after["kind"]).replace("_", " ") + " of")
    verb = "corrected" if after.get("replaces") else "entered"
    return f"{verb} {kind} {names.slot(after.get('plan_item_id'), after['plan_id'])}"


SAID: dict[str, Callable[[Row, Row, Names], str]] = {
    "plan": _plan,
    "visit_lock": lambda b, a, n: f"{'locked' if a.get('locked') else 'unlocked'} {n.visit(a['visit_id'])}",
    "margins_lock": lambda b, a, n: f"locked the margins of {n.participant(a['participant_id'])}",
    "declared_confirmation": lambda b, a, n: f"declared the confirmation of {n.policy(a['policy_id'])}",
    "bundle_release": lambda b, a, n: (
        f"took the bundle of {n.policy(a['policy_id'])}" if a["policy_id"] is not None else "took the bundle of a session without a policy"
    ),
    "port_check": lambda b, a, n: f"checked a port of {n.policy(a['policy_id'])}, {a['target']}: {a['verdict']}",
    "buffer_gate_decision": _decided,
    "participant": _participant,
    "settings_version": _version("settings"),
    "margins_version": _version("margins"),
    "characteristics_version": _version("characteristics"),
    "dose": _dose,
    "visit": _visit,
    "cdbs_amplitude": _amplitude,
    "adverse_event": _adverse_event,
    "adverse_event_revision": _event_revision,
    "data_query": _query,
    "data_query_entry": _query_entry,
    "day_entry": _day_entry,
    "session": _session,
    "qoc": _of_session("entered the outcomes of", "corrected the outcomes of"),
    "session_conditions": _of_session("took down the conditions of", "corrected the conditions of"),
    "evaluation": lambda b, a, n: f"stored an evaluation of {n.participant((a or b)['participant_id'])}",
    "sweep": lambda b, a, n: f"stored {(a or b)['name']} of {n.participant((a or b)['participant_id'])}",
    "policy": _policy,
    "signature": _signature,
    "buffer_snapshot": lambda b, a, n: f"pinned the sessions that policies of {n.participant((a or b)['participant_id'])} learn from",
    "job": _job,
    "app_user": _account,
    "api_token": _token,
    "sign_in": lambda b, a, n: "signed out" if a.get("ended_at") and not b.get("ended_at") else "signed in",
    "study": _place("study"),
    "site": _place("site"),
    "membership": _membership,
    "second_factor": _second_factor,
    "sign_on_link": _sign_on_link,
    "column_mapping": _column_mapping,
    "signal_meaning": _signal_meaning,
    "upload": _upload,
    "upload_file": _file,
    "session_proposal": _proposal,
    "grasp_test": _grasp_test,
    "tremor_series": _tremor,
    "plan_item": _plan_item,
    "device": lambda b, a, n: f"took in a device of {n.participant((a or b)['participant_id'])}",
    "recording": _recording,
    "session_segment": _segment,
    "trace": lambda b, a, n: f"took in a trace of recording {(a or b)['recording_id']}",
    "snapshot_session": lambda b, a, n: f"pinned {n.session((a or b)['session_id'])} to snapshot {(a or b)['snapshot_id']}",
    "estimate": lambda b, a, n: f"stored an estimate of {n.policy((a or b)['policy_id'])}",
    "stored_file": lambda b, a, n: f"stored a file of {(a or b)['size']} bytes",
}
"""By table. Their order says which change names an act, first to last."""
ACCOMPANY = frozenset(
    {"session_proposal", "grasp_test", "tremor_series", "plan_item", "device", "recording", "session_segment", "trace",
     "snapshot_session", "estimate", "stored_file"}
)  # fmt: skip
"""Tables whose rows come with an act that another row names; their sentences are read where a filter leaves nothing else."""
