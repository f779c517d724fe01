"""docs/trust.md: every clause has a test that exists, or says that it is not covered; `tests/test_docs.py` looks the names up."""

from __future__ import annotations

import re
import tomllib
from pathlib import Path

from tests.promises import PROMISES

ROOT = Path(__file__).resolve().parents[1]
TEST = re.compile(r"`(tests/[\w/]+\.py)(?:: (\w+))?`")
NOT_BROKEN = {
    "tests/app/accounts/test_many_sign_ins.py::test_static_files_do_not_wait_for_passwords",
    "tests/app/accounts/test_passwords.py::test_what_is_not_is_taken",
    "tests/app/accounts/test_sign_on.py::test_what_cannot_be_verified_lets_nobody_in",
    "tests/app/ingest/safety/test_files_in_a_bucket.py::test_machines_with_other_keys_do_not_start",
    "tests/app/ingest/safety/test_files_in_a_bucket.py::test_quarantined_bytes_are_encrypted_there_and_gone_everywhere_once_decided",
    "tests/app/ingest/uploads/test_incoming_files.py::test_without_a_list_of_open_files_the_bytes_have_a_name_that_only_the_owner_reads",
    "tests/app/ingest/uploads/test_lethal_files.py::test_the_web_process_never_reads_a_file_itself",
    "tests/app/ingest/uploads/test_many_files.py::test_a_hostile_file_ends_as_a_sentence_and_the_good_one_beside_it_counts",
    "tests/app/ingest/uploads/test_uploads.py::test_no_identity_of_a_device_file_is_stored_anywhere",
    "tests/app/learning/policies/test_foreign_policies.py::test_a_hostile_policy_is_refused_in_words_and_costs_the_service_nothing",
    "tests/app/overview/test_data_package.py::test_its_own_script_recomputes_the_primary_tables_without_betaloop",
    "tests/app/pages/test_every_page.py::test_every_address_of_a_browser_answers_and_every_page_is_small",
    "tests/app/pages/test_study_pages.py::test_a_visit_is_added_by_form_with_the_amplitude_of_each_side",
    "tests/app/planning/bundles/test_bundles.py::test_a_bundle_is_signed_with_the_key_that_the_service_tells",
    "tests/app/planning/plans/test_sign_off.py::test_limits_are_set_with_the_draft_and_signed",
    "tests/app/planning/releases/test_releases.py::test_a_clinician_releases_a_policy_over_its_bytes_and_limits",
    "tests/app/planning/releases/test_releases.py::test_a_plan_is_approved_without_releases_unless_they_are_asked_for",
    "tests/app/planning/releases/test_releases.py::test_any_change_breaks_it_visibly",
    "tests/app/platform/jobs/test_job_parts.py::test_the_stream_stops_for_whom_may_listen_no_more",
    "tests/app/platform/test_first_start.py::test_secrets_are_one_for_all_that_start_at_once",
    "tests/app/platform/test_full_disk.py::test_full_disks_are_told_in_words_and_leave_nothing_wrong_behind",
    "tests/app/platform/test_released_database.py::test_every_page_of_a_released_study_opens",
    "tests/app/platform/test_released_database.py::test_the_trail_of_the_release_is_whole_after_the_upgrade",
    "tests/app/platform/test_released_database.py::test_tokens_of_the_release_end_ninety_days_after_the_upgrade",
    "tests/app/platform/test_service_role.py::test_the_service_has_the_rights_it_needs_and_no_other",
    "tests/app/platform/upkeep/test_backup.py::test_a_backup_comes_back_in_another_postgresql",
    "tests/app/study/data_queries/test_data_queries.py::test_a_query_is_asked_answered_by_a_correction_and_closed",
    "tests/app/study/participation/test_withdrawn_marks.py::test_every_page_of_a_participant_who_has_withdrawn_says_so",
    "tests/app/study/test_margin_signatures.py::test_a_lock_is_signed_over_its_values",
    "tests/app/study/test_study_api.py::test_every_write_leaves_an_audit_row_that_cannot_be_changed",
    "tests/app/test_generated_input.py::test_generated_input_on_rows_that_exist_is_answered_as_described",
    "tests/app/test_routes.py::test_every_route_against_every_scope",
    "tests/app/test_routes.py::test_the_interface_keeps_to_its_own_description",
    "tests/benchmarks/test_soak.py::test_kills_of_every_process_lose_and_double_nothing",
    "tests/benchmarks/test_soak.py::test_under_load_no_request_fails_and_no_write_is_lost",
    "tests/browser/test_entries.py::test_signing_out_forgets_and_an_expired_sign_in_does_not",
    "tests/browser/test_entries.py::test_what_one_person_entered_is_never_saved_under_anothers_name",
    "tests/browser/test_visit_day_tls.py::test_over_tls_a_tablet_keeps_entries_and_opens_without_network",
    "tests/packages/test_service_lock.py::test_the_image_installs_that_lock_alone",
    "tests/test_docs.py::test_what_a_document_names_exists",
    "tests/test_trust.py::test_every_promise_that_is_broken_on_purpose_is_still_there",
    "tests/test_trust.py::test_the_rules_of_bandit_are_checked",
    "tests/test_trust.py::test_the_tests_without_a_change_that_breaks_them_are_listed",
}
"""Tests that the document names and that no promise is shown by: what would break each of them was not tried."""


def rows() -> list[tuple[str, str, str]]:
    """Clause, what is done and what shows it, of every row of the tables."""
    found = []
    for line in (ROOT / "docs" / "trust.md").read_text().splitlines():
        cells = [cell.strip() for cell in line.strip("|").split("|")]
        if line.startswith("|") and not set(line) <= set("|-") and cells[0] not in ("clause", "chapter", "found"):
            assert len(cells) == 3, line
            found.append((cells[0], cells[1], cells[2]))
    return found


def test_every_clause_is_shown_by_a_test_or_said_not_to_be_covered() -> None:
    assert [clause for clause, done, shown in rows() if not TEST.search(shown) and "not covered" not in done] == []


def test_every_named_test_is_one_that_can_fail() -> None:
    for clause, _, shown in rows():
        for path, name in TEST.findall(shown):
            source = (ROOT / path).read_text()
            assert name == "" or re.search(rf"^(async )?def {name}\(", source, re.MULTILINE), f"{clause}: {path} has no {name}"


def test_the_lists_are_whole() -> None:
    """The clauses of subparts B and C, and the chapters of the standard."""
    text = " ".join(clause for clause, _, _ in rows())
    for clause in (
        *(f"11.10({c})" for c in "abcdefghijk"),
        "11.30",
        "11.50",
        "11.70",
        *(f"11.300({c})" for c in "abcde"),
        "11.200(a)",
        "11.200(b)",
    ):
        assert clause in text, clause
    for chapter in range(1, 15):
        assert re.search(rf"\bV{chapter}\b", text), f"V{chapter}"


def test_the_rules_of_bandit_are_checked() -> None:
    lint = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["ruff"]["lint"]
    assert "S" in lint["select"]
    # what is left out is written down here and in pyproject.toml with its reason: nothing that calls a shell or builds SQL
    assert {rule for rule in lint["ignore"] if rule.startswith("S")} == {"S101", "S603", "S607"}
    assert {names for names, rules in lint["per-file-ignores"].items() if "S" in rules} == {"benchmarks/*", "tests/*"}


def test_every_promise_that_is_broken_on_purpose_is_still_there() -> None:
    """`python -m tests.broken_promises` breaks them; here only that each would be another code, and that its test is there."""
    for promise in PROMISES:
        path, _, name = promise.test.partition("::")
        assert (ROOT / promise.file).read_text().count(promise.old) == 1, promise
        assert promise.new != promise.old
        assert not name or f"def {name.rpartition('::')[2]}(" in (ROOT / path).read_text(), promise


def test_the_tests_without_a_change_that_breaks_them_are_listed() -> None:
    """Those that the document names and that no promise is shown by: it says where they are listed, and claims no more."""
    text = (ROOT / "docs" / "trust.md").read_text()
    named = {f"{path}::{name}" for path, name in TEST.findall(text) if name}
    assert named - {promise.test for promise in PROMISES} == NOT_BROKEN
    assert "`NOT_BROKEN` in `tests/test_trust.py`" in text
