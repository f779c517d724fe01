"""Promises of docs/trust.md about looks, exports, the search of the audit trail, and questions about values."""

from __future__ import annotations

from tests.promised.promise import Promise, of

LOOKS, FOUND = "tests/app/overview/test_looks_and_exports.py", "tests/app/overview/test_audit_search.py"
SAID = "tests/app/overview/test_audit_words.py::test_every_table_of_the_trail_has_its_sentence"
KEY, QUERIES = "tests/app/planning/plans/test_sealed_key.py", "tests/app/study/data_queries/test_data_queries.py"

TRAIL: list[Promise] = [
    *of(
        "study/deps",
        ("who looked at results is in the trail", '        record_view(db, "results", path)\n', "        pass\n",
         f"{LOOKS}::test_who_looked_at_results_and_who_took_a_file_is_in_the_trail"),
        ("tables of results that are taken are exports", 'record(db, "export", "results", path, {"format": form})', "pass",
         f"{LOOKS}::test_each_table_that_is_taken_is_a_row_and_is_called_an_export"),
        ("who looked at a session is in the trail", 'record_view(db, "session", session.id)', "False",
         f"{LOOKS}::test_a_blinded_assessor_is_recorded_once_something_was_unblinded_for_them"),
        ("who looked at a visit is in the trail", 'record_view(db, "visit", visit.id)', "False",
         f"{LOOKS}::test_a_blinded_assessor_is_recorded_once_something_was_unblinded_for_them"),
        ("blinded assessors who look at results after the lock are in the trail",
         "caller.is_blinded and not repository.tells_some_arm(db, caller, request.path_params.get(\"code\"))", "caller.is_blinded",
         f"{LOOKS}::test_a_blinded_assessor_is_recorded_once_something_was_unblinded_for_them"),
    ),
    *of(
        "ingest/quarantine/service",
        ("who took an original under review is in the trail", 'record(db, "export", "upload_file", file.id)', "pass",
         f"{LOOKS}::test_files_that_are_sent_for_leave_a_row_too"),
    ),
    *of(
        "overview/trail_changes",
        ("every table of the trail is told in a sentence", '    "device": lambda', '    "devices": lambda', SAID),
    ),
    *of(
        "overview/commands",
        ("an export that fails halfway is in the trail", "db.commit()  # rows that were written", "db.flush()  # rows that were written",
         f"{FOUND}::test_an_export_that_fails_halfway_is_a_row_of_the_trail"),
    ),
    *of(
        "overview/trail_scope",
        ("a row that outlasts its visit is told to its study", "for side in (first, second))", "for side in (first, first))",
         "tests/app/overview/test_audit_scope.py::test_rows_of_a_visit_that_was_removed_stay_in_the_trail_of_its_study"),
    ),
    *of(
        "overview/trail",
        ("who took the trail is in the trail", 'record(db, "export", "audit", "trail", {"filters": stated})', "pass",
         f"{FOUND}::test_taking_the_table_is_a_row_of_the_trail_that_keeps_no_words"),
        ("no name that somebody looked for stays in the trail", 'stated["words"] = "stated"', "pass",
         f"{FOUND}::test_taking_the_table_is_a_row_of_the_trail_that_keeps_no_words"),
    ),
    *of(
        "overview/trail_rows",
        ("no search tells what is hidden under a sealed key", "values if hidden is None else and_(not_(hidden), values)", "values",
         f"{KEY}::test_no_search_and_no_table_of_the_trail_tells_an_arm_of_a_sealed_plan"),
        ("the trail is found by the kind of act", "    if wanted.action:\n", "    if False:\n",
         f"{FOUND}::test_a_filter_leaves_what_it_says_on_the_page_and_in_the_table"),
        ("the trail is found by the participant", "if code := wanted.participant.strip().lower():", "if code := '':",
         f"{FOUND}::test_a_participants_rows_are_all_of_theirs_and_of_nobody_else"),
    ),
    *of(
        "study/data_queries",
        ("a question keeps the value as it stood", "return value if isinstance(value, str) else",
         "return None if isinstance(value, str) else",
         f"{QUERIES}::test_every_clinical_value_is_asked_about_and_keeps_its_old_value"),
    ),
    *of(
        "overview/trail",
        ("the trail tells no arm of a sealed plan", "    if sealed:\n        hidden", "    if False:\n        hidden",
         f"{KEY}::test_the_audit_trail_tells_no_arm_of_a_sealed_plan"),
    ),
]  # fmt: skip
