"""Promises about people, studies and their ends, codes, bundles, the interface and healing; a part of `tests/promises.py`."""

from __future__ import annotations

from tests.promised.promise import Promise, of

MEMBERS = "tests/app/accounts/studies/test_members.py"
PREFIXES = "tests/app/accounts/studies/test_prefixes.py"
CLOSING = "tests/app/study/closing/test_closing.py"
BUNDLES = "tests/app/planning/bundles/test_bundles.py"
ACCOUNTS, TOKENS = "tests/app/accounts/test_accounts.py", "tests/app/accounts/test_tokens.py"
MANY, WEAK = "tests/app/accounts/test_many_sign_ins.py", "tests/app/accounts/test_passwords.py"
FACTOR, SIGN_ON = "tests/app/accounts/test_second_factor.py", "tests/app/accounts/test_sign_on.py"
PAGES, SIGN_IN = "tests/app/pages/test_page_roles.py", "tests/app/pages/test_sign_in_pages.py"
ROUTES, TABLES = "tests/app/test_routes.py", "tests/app/test_every_route.py"
HEADERS, HEALING = "tests/app/platform/web/test_headers.py", "tests/app/platform/test_healing.py"
LIMITS, BODIES = "tests/app/platform/web/test_source_limits.py", "tests/app/platform/web/test_body_limit.py"
INCOMING, FILES = "tests/app/ingest/uploads/test_incoming_files.py", "tests/app/ingest/uploads/test_many_files.py"
FOREIGN = "tests/app/learning/policies/test_foreign_policies.py"
MARGINS, RELEASES = "tests/app/study/test_margin_signatures.py", "tests/app/planning/releases/test_releases.py"

PEOPLE: list[Promise] = [
    *of(
        "accounts/studies",
        ("codes of another study are refused before they are looked up", "    if any(code.lower()",
         "    if False and any(code.lower()",
         f"{PREFIXES}::test_who_enrols_learns_no_code_of_another_study"),
        ("codes of a study have its prefix", "    if prefix and not (", "    if False and not (",
         f"{PREFIXES}::test_who_enrols_learns_no_code_of_another_study"),
        ("no prefix is the beginning of another", "        if lower.startswith(theirs.lower()) or", "        if False and",
         f"{PREFIXES}::test_prefixes_that_cannot_be_told_apart_or_are_in_use_are_refused"),
        ("a prefix waits for whoever enrols", "    lock_codes(db, exclusively=False)\n", "",
         f"{PREFIXES}::test_a_prefix_waits_for_whoever_enrols"),
    ),
    *of(
        "accounts/studies_web",
        ("no token gives a role", '    caller.require_browser()\n    given = studies_rules.grant(', "    given = studies_rules.grant(",
         f"{MEMBERS}::test_no_token_gives_or_ends_a_role_and_a_stranger_sees_nobody"),
    ),
    *of(
        "accounts/permissions",
        ("nothing in a study that has ended changes", " and (not self.ended or permission in AFTER_END)", "",
         f"{CLOSING}::test_a_study_that_has_ended_is_read_and_nothing_in_it_changes"),
    ),
    *of(
        "study/access",
        ("a site that has ended takes no data", "    if site.ended_at is not None:\n", "    if False:\n",
         f"{CLOSING}::test_an_ended_site_takes_neither_enrolments_nor_uploads_and_all_else_goes_on"),
    ),
    *of(
        "study/participation",
        ("jobs of a study that has ended are cancelled", "in jobs.live_of(db, participant_id):\n", "in ():\n",
         f"{CLOSING}::test_jobs_of_an_ended_study_are_cancelled"),
    ),
    *of(
        "study/repository",
        ("Today leaves out studies that have ended", ", Study.ended_at.is_(None))", ")",
         f"{CLOSING}::test_today_leaves_an_ended_study_out_until_it_is_asked_for"),
    ),
    *of(
        "planning/bundles/service",
        ("a bundle that is taken again writes no file", "    if sha256 is None or not files.is_whole(sha256):\n",
         "    if True:\n",
         f"{BUNDLES}::test_the_same_bundle_taken_twice_is_one_file_and_stands_twice_in_the_audit_trail"),
        ("viewers take no bundles", "    access.require(caller, can.TAKE_BUNDLES, participant)\n", "",
         f"{BUNDLES}::test_who_may_only_read_takes_no_bundle_and_leaves_no_trace"),
    ),
    *of(
        "accounts/service",
        ("who signs out is signed out on the server", "        row.ended_at = now()\n", "        pass\n",
         "tests/app/pages/test_sign_in_pages.py::test_signing_out_ends_the_session_on_the_server"),
        ("an address has one account", "    if repository.user_by_email(db, email):\n        raise Conflict",
         "    if False:\n        raise Conflict", f"{ACCOUNTS}::test_names_of_tokens_and_addresses_are_unique"),
        ("stored passwords cost what they should", "FewAtOnce(time_cost=2", "FewAtOnce(time_cost=1",
         f"{WEAK}::test_passwords_are_stored_at_the_cost_that_owasp_recommends"),
        ("guesses at the present password are counted", "    confirm_password(user_id, present, code)\n", "",
         f"{TOKENS}::test_the_present_password_cannot_be_guessed_without_limit"),
    ),
    *of(
        "accounts/repository",
        ("padded spellings are one address", ".strip().casefold()).lower().strip()", ".casefold()).lower()",
         f"{ACCOUNTS}::test_padded_and_look_alike_spellings_are_one_address"),
    ),
    *of(
        "platform/web/sources",
        ("no more sign-ins wait than may", "        if self._present >= self.most:\n", "        if False:\n",
         f"{MANY}::test_more_than_can_wait_are_asked_to_come_back"),
    ),
    *of(
        "accounts/permissions",
        ("a role may what is written", "_VIEWER = frozenset({READ, READ_ARMS})", "_VIEWER = frozenset({READ, READ_ARMS, UPLOAD})",
         "tests/app/accounts/test_permissions.py::test_a_role_may_what_is_written_here"),
    ),
    *of(
        "accounts/second_factor",
        ("a lost second factor is removed", "        db.delete(row)\n", "        pass\n",
         f"{FACTOR}::test_an_administrator_of_the_machine_removes_a_lost_one"),
    ),
    *of("accounts/second_factor", ("codes are those of RFC 6238", "generate_otp(step)", "generate_otp(step + 1)",
        f"{FACTOR}::test_codes_are_those_of_the_standard")),
    *of(
        "accounts/sign_on_provider",
        ("only an address that was verified signs on", 'claims.get("email_verified") is True', "True",
         f"{SIGN_ON}::test_nobody_without_an_account_is_let_in_and_none_is_made"),
    ),
    *of(
        "accounts/pages",
        ("a page is closed to roles that may not",
         "    caller.require(can.MANAGE_ACCOUNTS)\n    return _accounts_page(request, db, caller)\n",
         "    return _accounts_page(request, db, caller)\n", f"{PAGES}::test_every_page_against_every_role"),
    ),
    *of(
        "study/visits",
        ("a route is closed to roles that may not", "    require(caller, can.WRITE_STUDY, participant)\n    if repository.visit_by_number",
         "    if repository.visit_by_number", f"{ROUTES}::test_every_route_against_every_role"),
    ),
    *of(
        "study/repository",
        ("lists name nobody of another study",
         "    query = select(Participant).join(Participant.site).where(in_scope(caller))\n    if withdrawn",
         "    query = select(Participant).join(Participant.site)\n    if withdrawn",
         f"{PAGES}::test_an_administrator_of_another_study_or_site_sees_and_changes_nothing"),
    ),
    Promise("a page that the table lacks fails", "tests/app/pages/page_roles.py", '    "/jobs": can.READ,\n', "",
            f"{PAGES}::test_every_page_and_every_form_is_in_the_table"),
    Promise("a route that the table lacks fails", "tests/app/route_roles.py", '    ("post", "/api/v1/studies"): can.MANAGE_ACCOUNTS,\n', "",
            f"{TABLES}::test_the_table_of_roles_has_every_route_and_no_other"),
    *of(
        "platform/files",
        ("stored files are the service's alone", "        draft.chmod(0o600)\n", "        draft.chmod(0o644)\n",
         "tests/app/platform/embedded/test_database_access.py::test_stored_files_are_the_services_alone"),
    ),
    *of(
        "platform/raw_bytes",
        ("raw bytes are encrypted", "        return cipher.update(content)\n", "        return bytes(content)\n",
         f"{INCOMING}::test_raw_bytes_have_no_name_are_encrypted_and_can_be_opened_by_their_owner"),
    ),
    *of(
        "ingest/uploads/receiving",
        ("what could not be cleaned is encrypted", "        except ReaderFault as fault:\n            # a fault of ours",
         "        except ZeroDivisionError as fault:\n            # a fault of ours",
         f"{FILES}::test_a_fault_while_identity_is_taken_out_keeps_the_file_encrypted"),
    ),
    *of(
        "learning/foreign",
        ("policies of strangers are opened in children", '        return run_limited(reference, params, LIMITS, who="policies")\n',
         '        module, _, name = reference.partition(":")\n'
         '        return dict(getattr(__import__(module, fromlist=[name]), name)(params))\n',
         f"{FOREIGN}::test_the_web_process_runs_no_policy_made_elsewhere"),
    ),
    *of(
        "settings",
        ("a damaged key is never used", "    if len(key) != 32:\n", "    if False:\n",
         "tests/app/platform/embedded/test_first_start.py::test_a_damaged_secret_is_refused_and_never_used"),
    ),
    *of(
        "platform/database/__init__",
        ("logs hold no values", "hide_parameters=True", "hide_parameters=False",
         f"{SIGN_IN}::test_a_server_error_has_every_header_and_logs_no_values"),
    ),
    *of(
        "platform/database/__init__",
        ("a database that was killed comes back", "            if server.heal():\n", "            if False:\n",
         f"{HEALING}::test_a_service_whose_database_was_killed_heals_by_itself"),
        at_start=True,
    ),
    *of(
        "platform/web/middleware",
        ("a wrong method is told every right one", '        response.headers["Allow"] = ", ".join(_methods(request))\n', "        pass\n",
         f"{HEADERS}::test_a_wrong_method_is_told_every_right_one"),
    ),
    *of(
        "platform/web/request_bodies",
        ("a large document is not read", "        if (self._stated or 0) > self._limit:\n", "        if False:\n",
         f"{BODIES}::test_a_large_document_is_refused_before_it_is_read"),
        ("files are counted for who sends them", "        if wait_s := sent.take(source, size):\n", "        if wait_s := 0:\n",
         f"{LIMITS}::test_files_beyond_what_a_source_may_send_are_refused_in_words"),
    ),
    *of(
        "accounts/deps",
        ("figures are for who has signed in", "        get_caller(request, db, bearer)\n", "        pass\n",
         "tests/app/platform/web/test_figures.py::test_a_stranger_reads_neither"),
    ),
    *of(
        "cli",
        ("sessions leave the machine over HTTPS alone",
         '    elif host not in LOOPBACK and "cookie_secure" not in settings.model_fields_set:\n',
         "    elif False:\n", f"{HEADERS}::test_sessions_leave_the_machine_over_https_alone_unless_somebody_says_otherwise"),
    ),
    Promise("the web process starts without torch", "app/main.py", "from __future__ import annotations\n",
            "from __future__ import annotations\n\nimport torch\n",
            "tests/app/test_heavy_imports.py::test_the_web_process_never_loads_torch_and_starts_without_what_it_may_never_need"),
    *of(
        "study/margins",
        ("a signature covers why margins were locked", '        "lock_reason": lock.reason,\n', "",
         f"{MARGINS}::test_any_change_breaks_it_visibly"),
    ),
    *of(
        "planning/releases",
        ("releases are asked for where the installation says so", "            if get_settings().require_released_policies:\n",
         "            if False:\n", f"{RELEASES}::TestPlans::test_a_plan_is_approved_without_releases_unless_they_are_asked_for"),
    ),
    *of(
        "cli",
        ("a stop leaves no postmaster", "    signal.signal(signal.SIGTERM, end)\n", "",
         "tests/app/platform/test_stops.py::test_a_stopped_service_leaves_nothing_behind"),
        ("connections outlive a pause", "timeout_keep_alive=75", "timeout_keep_alive=5",
         "tests/app/platform/web/test_keep_alive.py::test_a_connection_outlives_a_pause"),
        at_start=True,
    ),
    *of(
        "platform/jobs/steps",
        ("a step whose process was killed is tried once more", 'if outcome["ok"] or outcome["cause"] != "killed" or attempt ==',
         'if True or attempt ==', "tests/app/platform/jobs/test_job_runs.py::test_a_step_whose_process_was_killed_is_tried_once_more"),
        at_start=True,
    ),
]  # fmt: skip
