"""Promises about records: the trail, what writes it, its rows, and that nothing is deleted."""

from __future__ import annotations

from tests.promised.promise import Promise
from tests.promised.promise import of as _of

CHAIN, PAST = "tests/app/platform/test_audit_chain.py", "tests/app/platform/audit/test_past_the_trail.py"
MARGINS, KEPT = "tests/app/study/test_margin_signatures.py", "tests/app/study/test_nothing_is_deleted.py"
REFUSALS, MARKS = "tests/app/accounts/test_refusals_in_the_trail.py", "tests/app/study/participation/test_withdrawn_marks.py"


RECORDS = [
    *_of(
        "platform/audit/guards",
        ("a trigger that is off is found", ' and enabled in ("O", "A"):', ":", f"{CHAIN}::test_a_trigger_that_is_off_is_named"),
        ("a function that writes nothing is found", "same = hashlib.sha256(source.encode()).hexdigest() == sha256", "same = True",
         f"{PAST}::test_what_would_keep_later_writes_from_the_trail_is_named"),
        ("a trigger that leaves a column out is found", ' and (name != "audit" or given == arguments.get(table))', "",
         f"{PAST}::test_what_would_keep_later_writes_from_the_trail_is_named"),
        ("a default that writes other times is found", "*_triggers(db), *_defaults(db)]", "*_triggers(db)]",
         f"{PAST}::test_a_default_that_would_write_other_times_or_words_is_named"),
        ("a trigger of others is found", "if not (own and (name, function, moment) in KNOWN):", "if False:",
         f"{PAST}::test_what_would_keep_later_writes_from_the_trail_is_named"),
    ),
    *_of(
        "platform/service_role",
        ("the service may not delete what was entered", "or table in DELETED_FROM", "or True",
         f"{KEPT}::test_the_service_may_not_delete_what_was_entered_or_measured"),
        at_start=True,
    ),
    Promise("nobody deletes a confirmed session", "migrations/versions/20261128_initial.py", "    op.execute(NEVER_DELETED)\n", "",
            f"{KEPT}::test_a_confirmed_session_is_deleted_by_nobody", at_start=True),
    *_of(
        "ingest/proposals/service",
        ("a question is never about nothing", "    if asked:\n        one", "    if False:\n        one",
         "tests/app/ingest/proposals/test_proposals.py::test_a_proposal_that_a_data_query_is_about_is_neither_dropped_nor_cut"),
    ),
    *_of(
        "study/doses",
        ("doses are not deleted", "    dose.removed_at = now()\n", "    db.delete(dose)\n",
         f"{KEPT}::test_a_dose_that_was_taken_back_stays_and_may_be_entered_anew"),
    ),
    *_of(
        "study/access",
        ("lists mark who has withdrawn", "if p.status == WITHDRAWN)", "if False)", f"{MARKS}::test_lists_mark_who_has_withdrawn"),
    ),
    *_of(
        "study/visits",
        ("cDBS amplitudes are not deleted", "                row.removed_at = now()\n", "                db.delete(row)\n",
         f"{KEPT}::test_an_amplitude_that_is_stated_no_more_stays_and_outlasts_its_visit"),
    ),
    *_of(
        "study/outcomes/service",
        ("grasp tests that moved stay", "    for row in elsewhere:\n        row.removed_at = now()\n", 
         "    for row in elsewhere:\n        db.delete(row)\n",
         f"{KEPT}::test_grasp_tests_that_were_replaced_or_moved_stay_as_they_were"),
        ("replaced minutes stay as they were", "if before is not None and tremor.same_values(before, row):", "if before is not None:",
         f"{KEPT}::test_minutes_that_a_newer_reading_replaced_stay_as_they_were"),
        ("grasp tests outlast a proposal", "    for row in of_files.grasp_tests(db, session.id):\n        row.removed_at = now()\n", "",
         f"{KEPT}::test_grasp_tests_outlast_a_proposal_that_was_given_up"),
    ),
    *_of(
        "platform/audit/chain",
        ("a time that goes back is found", "if moment < latest - _A_DAY_US:", "if False:",
         f"{PAST}::test_what_was_written_at_a_false_time_stays_named_once_the_clock_is_right_again"),
        ("rows are held against the trail", "breaks += islice(past_the_trail(db), MOST_BREAKS)", "pass",
         f"{PAST}::test_what_was_written_past_the_trail_is_named"),
        ("a signature whose content was rewritten is named", "for i in changed_records(db)]", "for i in ()]",
         f"{PAST}::test_a_signature_that_was_rewritten_is_named"),
    ),
    *_of(
        "accounts/service",
        ("lock-outs are in the trail",
         '        record_once(db, "refuse", "sign_in", address if known else "unknown address", '
         'LOCKED_OUT if locked else AT_ONCE, FAILURE_WINDOW)\n', "",
         f"{REFUSALS}::test_a_lock_out_is_one_row_however_often_it_is_tried"),
        ("wrong passwords at signatures are in the trail", 'record(db, "refuse", "confirmation", user.email, {"why": wrong[0]})', "pass",
         f"{REFUSALS}::test_a_wrong_password_at_a_signature_is_in_the_trail"),
    ),
    *_of(
        "platform/audit/signatures",
        ("signatures are bound to the trail", " and _as_recorded(signature)", "",
         f"{MARGINS}::test_a_signature_that_was_rewritten_with_its_values_does_not_stand"),
    ),
]  # fmt: skip
