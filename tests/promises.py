"""What docs/trust.md promises, each with a change of the code that breaks it and the test that shows it (`tests/broken_promises.py`)."""

from __future__ import annotations

from dataclasses import dataclass

CHAIN = "tests/app/platform/test_audit_chain.py"
ROLE = "tests/app/platform/test_service_role.py"
ACCOUNTS, TOKENS = "tests/app/accounts/test_accounts.py", "tests/app/accounts/test_tokens.py"
FACTOR, SIGN_ON = "tests/app/accounts/test_second_factor.py", "tests/app/accounts/test_sign_on.py"
SIGNED = "tests/app/accounts/test_sign_on_signatures.py"
STUDIES, ROUTES = "tests/app/accounts/studies/test_studies.py", "tests/app/test_routes.py"
ERROR_PAGES = "tests/app/pages/test_error_pages.py"
FLAWS = "tests/packages/test_known_flaws.py"
MEMBERS = "tests/app/platform/test_json_members.py"
PAGES, SIGN_IN = "tests/app/pages/test_page_roles.py", "tests/app/pages/test_sign_in_pages.py"
HEALING, DOCTOR = "tests/app/platform/test_healing.py", "tests/app/platform/upkeep/test_doctor.py"
SEALING, BACKUP = "tests/app/platform/upkeep/test_sealing.py", "tests/app/platform/upkeep/test_backup.py"
DAMAGED, INTERRUPTED = "tests/app/ingest/uploads/test_damaged_files.py", "tests/app/ingest/uploads/test_interrupted.py"
LOCKS, LOCK_SIGNED = "tests/app/study/visits/test_visit_locks.py", "tests/app/study/visits/test_lock_signatures.py"
PLANS, KEY = "tests/app/planning/plans/test_sign_off.py", "tests/app/planning/plans/test_sealed_key.py"
RELEASES, MARGINS = "tests/app/planning/releases/test_releases.py", "tests/app/study/test_margin_signatures.py"
SIGNATURES = "tests/app/platform/signatures/test_signatures.py"
QUARANTINE, QUERIES = "tests/app/ingest/quarantine/test_quarantine.py", "tests/app/study/data_queries/test_data_queries.py"
SCOPE, HEADERS = "tests/app/overview/test_audit_scope.py", "tests/app/platform/web/test_headers.py"
MALFORMED, HASHES = "tests/app/platform/test_malformed_bodies.py", "tests/app/accounts/test_few_hashes_at_once.py"
PASSWORDS, NUMBERS = "tests/app/accounts/test_passwords.py", "tests/app/platform/web/test_schemas.py"
LIMITS, BODIES = "tests/app/platform/web/test_source_limits.py", "tests/app/platform/web/test_body_limit.py"
OWNED, FIGURES = "tests/app/test_ids_belong_together.py", "tests/app/platform/web/test_figures.py"


@dataclass(frozen=True)
class Promise:
    """What is promised, a change of the code that breaks it (a file, a text that stands in it once, another text), and the test."""

    said: str
    file: str
    old: str
    new: str
    test: str
    at_start: bool = False
    """Whether it is kept when the databases of all tests are made, so that it must be broken before."""


def _of(file: str, *broken: tuple[str, str, str, str], at_start: bool = False) -> list[Promise]:
    """Promises that one file keeps: sentence, text, other text, test."""
    return [Promise(said, f"app/{file}.py", old, new, test, at_start) for said, old, new, test in broken]


PROMISES = [
    Promise("the compose file leaves cookies to HTTPS", "docker-compose.yml", "      BETALOOP_COOKIE_SECURE:\n",
            "      BETALOOP_COOKIE_SECURE: ${BETALOOP_COOKIE_SECURE:-false}\n",
            "tests/test_compose.py::test_people_sign_in_over_https_alone_unless_somebody_says_otherwise", at_start=True),
    Promise("known flaws of pinned packages fail the checks", "tests/packages/known_flaws.py", "return 1 if flaws else 0", "return 0",
            f"{FLAWS}::test_known_flaws_fail_and_are_named"),
    Promise("a server that is not the list is no clean answer", "tests/packages/known_flaws.py", "or not numbers[0]:", "or False:",
            f"{FLAWS}::test_what_is_not_the_list_is_never_taken_for_a_clean_answer"),
    *_of(
        "platform/audit/chain",
        ("an edited row is found", "elif digest_of(before, fields) != stored:", "elif False:",
         f"{CHAIN}::test_what_the_owner_changes_is_found"),
        ("a removed row is found", "if fields is None:", "if False:", f"{CHAIN}::test_what_the_owner_changes_is_found"),
        ("a gap is found", "if position != links:", "if False:", f"{CHAIN}::test_what_the_owner_changes_is_found"),
        ("an added row is found", "for i in _unlinked(db)]", "for i in ()]", f"{CHAIN}::test_what_the_owner_changes_is_found"),
        ("an end that was cut off is found", "elif position > links:", "elif False:", f"{CHAIN}::test_what_the_owner_changes_is_found"),
        ("a chain that was computed anew is found", "elif digests.get(position) != digest:", "elif False:",
         f"{CHAIN}::test_what_the_owner_changes_is_found"),
        ("a forged seal is found", "if not hmac.compare_digest(mac, _mac(position, digest)):", "if False:",
         f"{CHAIN}::test_what_the_owner_changes_is_found"),
        ("a trigger that is off is found", "t.tgenabled in ('O', 'A') and ", "", f"{CHAIN}::test_a_trigger_that_is_off_is_named"),
        ("seals stand outside the database too", "*_seals_of_file()]", "]",
         f"{CHAIN}::test_a_seal_that_was_deleted_from_the_database_still_stands_in_its_file"),
    ),
    *_of(
        "platform/json_members",
        ("a document with a doubled member is refused", "if doubled is not None:", "if False:",
         f"{MEMBERS}::test_a_doubled_member_is_refused_and_nothing_is_stored"),
    ),
    *_of(
        "platform/audit/trail",
        ("looks at results are in the trail", '    record(db, "view", "results", what)\n', "",
         f"{CHAIN}::test_what_leaves_and_who_looked_is_in_the_trail"),
    ),
    *_of(
        "overview/package/export",
        ("exports are in the trail", 'record(db, "export"', '(lambda *_: None)(db, "export"',
         f"{CHAIN}::test_what_leaves_and_who_looked_is_in_the_trail"),
    ),
    *_of(
        "overview/trail/repository",
        ("nobody reads the trail of another study", "select(Site.id).where(or_(false(), *allowed))", "select(Site.id)",
         f"{SCOPE}::test_every_row_of_ones_own_study_is_shown_and_none_of_another"),
    ),
    *_of(
        "platform/service_role",
        ("the service's role cannot write the trail", '"audit_event": frozenset({READ}),', '"audit_event": frozenset({READ, INSERT}),',
         f"{ROLE}::test_the_services_role_is_refused"),
        ("it deletes nothing clinical", "deletes = schema == ENGINE_SCHEMA or table in DELETED_FROM", "deletes = True",
         f"{ROLE}::test_the_services_role_is_refused"),
        ("a role that owns tables is found", "    if owned:\n", "    if False:\n", f"{ROLE}::test_a_role_that_owns_the_tables_is_found"),
        at_start=True,
    ),
    *_of(
        "platform/signatures/service",
        ("a signature stands for its content alone", "signature.sha256 == content_hash(content) == content_hash(signature.content)",
         "signature.sha256 == content_hash(signature.content)", f"{SIGNATURES}::test_a_signature_stands_for_its_content_alone"),
        ("a signature whose own record was changed does not stand",
         "signature.sha256 == content_hash(content) == content_hash(signature.content)", "signature.sha256 == content_hash(content)",
         f"{SIGNATURES}::test_a_record_that_was_tampered_with_does_not_stand"),
    ),
    *_of(
        "accounts/signing",
        ("a signature asks for the password", "        confirm_password(caller.user_id, password, code)\n", "        pass\n",
         f"{SIGNATURES}::test_a_wrong_password_signs_nothing_and_cannot_be_guessed_without_limit"),
        ("a signature asks for the second factor", "confirm_password(caller.user_id, password, code)",
         "confirm_password(caller.user_id, password)",
         f"{FACTOR}::test_signatures_and_a_new_password_need_a_code"),
        ("a sign-on stands for one signature", "        use_confirmation(db, caller)\n", "        pass\n",
         f"{SIGNED}::test_a_fresh_sign_on_stands_for_the_password_of_one_signature"),
    ),
    *_of(
        "accounts/sign_on/service",
        ("one login stands for one signature", "if not repository.use_login(db, link, identity.asked_at):", "if False:",
         f"{SIGNED}::test_one_login_at_the_provider_stands_for_one_signature"),
        ("nobody else confirms", "if row is None or link.user_id != caller.user_id:", "if row is None:",
         f"{SIGNED}::test_nobody_else_confirms_and_an_old_sign_on_does_not"),
        ("a closed account stays closed to the sign-on", "    if not user.active:\n", "    if False:\n",
         f"{SIGN_ON}::test_a_closed_account_stays_closed"),
        ("an account belongs to one person there", "if repository.link_of_user(db, user.id, identity.issuer):", "if False:",
         f"{SIGN_ON}::test_an_address_that_was_given_to_somebody_else_opens_no_account"),
        ("look-alikes of an address open no account", "and user.email == address.strip().lower() else None", "else None",
         f"{SIGN_ON}::test_look_alikes_of_an_address_open_no_account"),
    ),
    *_of(
        "accounts/service",
        ("a closed account signs nothing", "_hasher.verify(password, user.password_hash) and user.active)",
         "_hasher.verify(password, user.password_hash))",
         f"{SIGNATURES}::test_a_closed_account_and_the_system_sign_nothing"),
        ("guessing ends", "if repository.recent_failures(db, address, FAILURE_WINDOW) >= FAILURES_ALLOWED:", "if False:",
         f"{ACCOUNTS}::test_five_failures_lock_the_address_and_a_pause_unlocks_it"),
        ("guesses at one moment count", "    repository.lock_address(db, address)\n", "",
         f"{ACCOUNTS}::test_guesses_at_the_same_moment_are_judged_no_more_often_than_allowed"),
        ("failed sign-ins are pruned", "    repository.prune_failures(db, FAILURE_WINDOW)\n", "",
         f"{ACCOUNTS}::test_tries_that_count_no_more_are_removed"),
        ("refused sign-ins are in the trail", 'record(db, "refuse", "sign_in", user.email if user else "unknown address")', "pass",
         f"{CHAIN}::test_refused_sign_ins_are_in_the_trail_and_no_password_that_was_typed_as_an_address"),
        ("no password that was typed as an address is kept", 'user.email if user else "unknown address")', "email)",
         f"{CHAIN}::test_refused_sign_ins_are_in_the_trail_and_no_password_that_was_typed_as_an_address"),
        ("a new password ends tokens", "token.revoked_at = token.revoked_at or now()", "pass",
         f"{TOKENS}::test_a_new_password_ends_tokens_and_browser_sessions"),
        ("a new password ends browser sessions", "        sign_in.ended_at = now()\n", "        pass\n",
         f"{TOKENS}::test_a_new_password_ends_tokens_and_browser_sessions"),
        ("session tokens are stored as hashes", "SignIn(token_sha256=_hash(token), user_id", "SignIn(token_sha256=token, user_id",
         f"{ACCOUNTS}::test_a_password_opens_a_session_whose_token_is_not_stored"),
        ("signing in needs the code", "and attempt and second_factor.accepts(db, user.id, code)):", "and attempt):",
         f"{FACTOR}::test_signing_in_needs_a_code_that_was_not_used"),
        ("a narrow token administers nothing", "where = caller.grants_with(MANAGE_ACCOUNTS)",
         'where = tuple(g for g in caller.grants if g.role == "admin")',
         f"{TOKENS}::test_a_narrow_token_of_an_administrator_changes_no_study"),
        ("nobody manages a user without access", "return bool(user.memberships) and all(", "return all(",
         f"{TOKENS}::test_nobody_administers_a_user_without_any_access"),
        ("nobody revokes the token of another", "if row is None or row.user_id != user_id:", "if row is None:",
         f"{ACCOUNTS}::test_nobody_revokes_the_token_of_another"),
        ("the last use of a token is kept", "        row.last_used_at = now()\n", "        pass\n",
         f"{TOKENS}::test_the_last_use_of_a_token_is_kept_and_shown"),
        ("who is sent away has tried no password", "with place(), new_session() as db:", "with new_session() as db:",
         f"{HASHES}::test_who_finds_too_many_waiting_is_asked_to_come_back_and_has_tried_nothing"),
        ("an account that was closed ends what lasts", "    if row is None or not row.user.active:\n        return None\n    if used",
         "    if row is None:\n        return None\n    if used",
          f"{TOKENS}::test_an_answer_that_lasts_learns_that_its_account_was_closed"),
    ),
    *_of(
        "accounts/passwords",
        ("common passwords are refused", "if _guesses(password, [email, name, *words]) < LEAST_GUESSES:", "if False:",
         f"{PASSWORDS}::test_what_is_guessed_first_is_refused"),
        ("one's own words are no passwords", 'f"{email} {name}".casefold()', '"".casefold()',
         f"{PASSWORDS}::test_what_others_know_of_somebody_is_no_secret"),
        ("no password takes long to judge", "zxcvbn(password[:MOST_JUDGED], ", "zxcvbn(password, ",
         f"{PASSWORDS}::test_no_password_takes_long_to_judge"),
        ("two passwords are verified at a time", "        with _turns:\n            return super().verify",
         "        if True:\n            return super().verify", f"{HASHES}::test_two_at_a_time_whoever_asks_and_for_whatever"),
        ("two passwords are hashed at a time", "        with _turns:\n            return super().hash",
         "        if True:\n            return super().hash", f"{HASHES}::test_two_at_a_time_whoever_asks_and_for_whatever"),
    ),
    Promise("tokens of the first release end", "migrations/versions/20261126_token_ends.py", "'90 days'", "'90 years'",
            "tests/app/platform/test_migrations.py::test_a_token_without_an_end_is_given_one_and_others_keep_theirs", at_start=True),
    *_of(
        "accounts/repository",
        ("tokens end on their day", ", ApiToken.expires_at > now())", ")",
         f"{TOKENS}::test_a_token_ends_on_its_day"),
        ("sessions end by idling", "SignIn.last_seen_at > idle_since, ", "", f"{ACCOUNTS}::test_a_session_ends_by_idling_and_by_age"),
        ("sessions end by age", ", SignIn.created_at > begun_since", "", f"{ACCOUNTS}::test_a_session_ends_by_idling_and_by_age"),
        ("revoked tokens are refused", ", ApiToken.revoked_at.is_(None), ", ", ", f"{ACCOUNTS}::test_a_token_works_until_it_is_revoked"),
    ),
    *_of(
        "accounts/second_factor",
        ("a code works once", "    row.last_used_at = datetime.fromtimestamp(step * totp.STEP_S, UTC)\n", "",
         f"{FACTOR}::test_signing_in_needs_a_code_that_was_not_used"),
        ("secrets of second factors are encrypted", "return nonce + AESGCM(_key()).encrypt(nonce, secret, str(user_id).encode())",
         "return nonce + secret", f"{FACTOR}::test_neither_the_database_nor_the_trail_holds_the_secret"),
        ("recovery codes are hashed with a key", "return hmac.digest(_key(), code.encode(), hashlib.sha256).hex()",
         "return hashlib.sha256(code.encode()).hexdigest()",
          f"{FACTOR}::test_recovery_codes_cannot_be_guessed_from_a_copy_of_the_database"),
    ),
    *_of(
        "accounts/permissions",
        ("a role holds in its study alone", "(study_id is None or g.study_id == study_id)", "True",
         f"{ACCOUNTS}::test_a_grant_reaches_its_study_and_site_only"),
        ("a role holds at its site alone", "(site_id is None or g.site_id is None or g.site_id == site_id)", "True",
         f"{ACCOUNTS}::test_a_grant_reaches_its_study_and_site_only"),
        ("a scope narrows", "        if left is not None and permission not in left:\n            return ()\n", "",
         f"{TOKENS}::test_a_scope_narrows_what_its_user_may_and_widens_nothing"),
        ("a token changes no account", "        if self.token_scope is not None:\n            raise Forbidden(\"A token may",
         "        if False:\n            raise Forbidden(\"A token may", f"{TOKENS}::test_a_token_changes_no_password_token_or_account"),
    ),
    *_of(
        "accounts/deps",
        ("a token for figures reads nothing else", "if caller.token_scope is Scope.METRICS and path != METRICS:", "if False:",
         f"{FIGURES}::test_a_token_for_figures_reads_them_and_nothing_else"),
        ("the address that is answered is the one that is judged", 'path = request.scope["path"]', "path = request.url.path",
         f"{TOKENS}::test_an_address_in_disguise_opens_nothing_more"),
        ("entries are saved under their writer's name alone", "if writer is not None and writer != caller.user_id:", "if False:",
         f"{ERROR_PAGES}::test_what_an_expired_sign_in_gives_back_is_sent_again_by_its_writer_alone"),
        ("what is not listed is closed to the blinded", "if caller.is_blinded and not is_open(request.method, path):", "if False:",
         f"{LOCKS}::test_whatever_is_not_listed_is_closed_to_blinded_assessors"),
    ),
    *_of(
        "accounts/studies/service",
        ("nobody changes their own role", "    if user.id == caller.user_id:\n", "    if False:\n",
         f"{STUDIES}::test_nobody_changes_the_own_role_and_no_token_gives_one"),
        ("nobody blinds who works in a study of others", "if role is Role.BLINDED_ASSESSOR and not all(", "if False and not all(",
         f"{STUDIES}::test_nobody_blinds_who_works_in_a_study_of_others"),
        ("a study is added by who administers all", "    if not all(administers(caller, study.id) for study in accounts.studies(db)):\n",
         "    if False:\n", f"{STUDIES}::test_who_administers_one_study_makes_none_and_sees_no_other"),
    ),
    *_of(
        "study/repository",
        ("participants of another study look as if they did not exist", ".where(Participant.code == code, in_scope(caller))",
         ".where(Participant.code == code)", f"{ROUTES}::test_a_caller_of_another_study_sees_nothing"),
        ("visits of another study look as if they did not exist", ".where(Visit.id == visit_id, in_scope(caller))",
         ".where(Visit.id == visit_id)",
         f"{ROUTES}::test_a_caller_of_another_study_sees_nothing"),
    ),
    *_of(
        "study/service",
        ("objects of another participant look as if they did not exist", "    if row.participant_id != participant.id:\n",
         "    if False:\n",
         f"{OWNED}::test_every_route_with_two_ids_refuses_another_participants"),
    ),
    *_of(
        "study/blinding",
        ("a blinded assessor learns nothing before the lock", "(user.may(can.READ_ARMS, site.study_id, site.id) or visit.locked)", "True",
         f"{LOCKS}::test_a_blinded_assessor_learns_what_ran_once_the_visit_is_locked"),
        ("nobody learns what ran while the key is sealed", "    return not visit.sealed and (", "    return (",
         f"{KEY}::test_traces_conditions_and_samples_are_refused_to_everybody_with_the_way_out"),
        ("what learns leaves sealed visits out", "return [s for s in sessions if not s.visit.sealed]", "return list(sessions)",
         f"{KEY}::test_what_learns_and_compares_leaves_the_visit_out_until_the_key_is_opened"),
    ),
    *_of(
        "overview/overview",
        ("the trail tells no arm of a sealed plan", "    if sealed:\n        hidden", "    if False:\n        hidden",
         f"{KEY}::test_the_audit_trail_tells_no_arm_of_a_sealed_plan"),
    ),
    *_of(
        "study/visits/service",
        ("a locked visit takes no change", "    if visit.locked:\n        last", "    if False:\n        last",
         f"{LOCKS}::test_a_locked_visit_takes_no_change_until_it_is_unlocked_with_a_reason"),
        ("locks are signed", "    sign_off.sign_lock(db, visit, row, caller, password, code)\n", "",
         f"{LOCK_SIGNED}::test_a_lock_is_signed_with_its_meaning_and_stands_in_the_trail"),
        ("a locked visit goes by the settings at its lock", "visit.participant.current_settings.id if locked else None", "None",
         f"{LOCK_SIGNED}::test_a_locked_visit_goes_by_the_settings_at_its_lock"),
    ),
    *_of(
        "study/visits/sign_off",
        ("doses are signed", '"doses": sorted(', '"doses": 0 and sorted(', f"{LOCK_SIGNED}::test_any_change_breaks_it_visibly"),
        ("samples are signed", '| {"samples": read.get(s.recording_id)}', "", f"{LOCK_SIGNED}::test_any_change_breaks_it_visibly"),
        ("which samples are valid is signed", ", t.valid_bits.hex()]", "]", f"{LOCK_SIGNED}::test_any_change_breaks_it_visibly"),
        ("exclusions are signed", '"excluded_reason", "stopped_reason"', '"stopped_reason"',
         f"{LOCK_SIGNED}::test_any_change_breaks_it_visibly"),
        ("the amplitude in force is signed", '| {"cdbs_amplitude_in_force_ma": _cdbs_ma(session, heads)}', "",
         f"{LOCK_SIGNED}::test_another_amplitude_in_the_version_at_the_lock_breaks_the_signature"),
    ),
    *_of(
        "planning/plans/sign_off",
        ("nobody signs what they drafted", "    if plan.created_by == caller.label:\n", "    if False:\n",
         f"{PLANS}::test_nobody_signs_what_they_drafted"),
        ("the bytes of policies are signed", '        "policy_sha256": policy.onnx_sha256 if policy else None,\n', "",
         f"{PLANS}::test_any_change_breaks_the_signature_visibly"),
    ),
    *_of(
        "planning/releases/service",
        ("who brought a policy does not release it", "    if brought is not None:\n", "    if False:\n",
         f"{RELEASES}::test_whoever_brought_a_policy_does_not_release_what_was_made_from_it"),
        ("no plan runs beyond a release", "    if beyond:\n", "    if False:\n", RELEASES),
        ("a retired policy is not released", "    if policy.retired_reason:\n", "    if False:\n",
         f"{RELEASES}::test_a_retired_policy_and_impossible_limits_are_refused"),
    ),
    *_of(
        "ingest/quarantine/service",
        ("a clinician alone decides on quarantined files", "    study_service.require(caller, can.DECIDE_QUARANTINE, participant)\n", "",
         f"{QUARANTINE}::test_only_a_clinician_or_an_administrator_decides"),
        ("nothing is released that nobody looked at", "    if file.reviewed_at is None:\n", "    if False:\n",
         f"{QUARANTINE}::test_a_file_is_released_as_it_is_only_after_somebody_looked"),
        ("tampered bytes are refused", "        if raw.sha256() != file.report.get(ASIDE, file.original_sha256):\n", "        if False:\n",
         f"{QUARANTINE}::test_tampered_bytes_are_refused_in_words"),
    ),
    *_of(
        "ingest/encryption",
        ("what cannot be read is encrypted", "out.write(cipher.encrypt(chunk) + b", "out.write(chunk + b",
         f"{DAMAGED}::test_a_damaged_file_in_quarantine_comes_back_encrypted"),
    ),
    *_of(
        "ingest/uploads/receiving",
        ("bytes that come again replace damaged ones", "return self._mended(raw, known)", "return known",
         f"{DAMAGED}::test_the_same_bytes_sent_again_take_the_place_of_a_damaged_file"),
    ),
    *_of(
        "platform/files",
        ("damaged bytes are not kept", "    if whole_at(target, sha256) or (", "    if target.exists() or (",
         f"{DAMAGED}::test_bytes_that_are_kept_a_second_time_replace_damaged_ones"),
    ),
    *_of(
        "platform/upkeep/backup",
        ("a backup goes on around a damaged file", "        if not files.whole_at(path, sha256):\n            return False\n", "",
         f"{DAMAGED}::test_a_backup_goes_on_around_a_damaged_file_and_names_it"),
        ("a damaged backup is refused before anything is written", "    manifest = verify(folder)\n",
         "    manifest = json.loads((folder / MANIFEST).read_text())\n",
         f"{BACKUP}::test_a_damaged_backup_is_refused_before_anything_is_written"),
        ("a key beside what it protects is refused", "if path.resolve().is_relative_to(folder.resolve()):", "if False:",
         f"{BACKUP}::test_a_key_beside_what_it_protects_is_refused"),
        ("no backup is overwritten", "    if folder.exists():\n", "    if False:\n",
         f"{BACKUP}::test_neither_a_key_nor_a_backup_is_overwritten"),
        ("half a database is not kept", "            if unpacking.wait() == 0:\n", "            if True:\n",
         f"{BACKUP}::test_a_restore_that_breaks_off_leaves_no_half_of_the_database"),
    ),
    *_of(
        "platform/upkeep/sealing",
        ("chunks cannot be exchanged", 'prefix + struct.pack(">I?", number, last)', 'prefix + struct.pack(">I?", 0, last)',
         f"{SEALING}::test_whatever_was_done_to_it_is_noticed"),
        ("an end cannot be cut off", 'prefix + struct.pack(">I?", number, last)', 'prefix + struct.pack(">I?", number, False)',
         f"{SEALING}::test_whatever_was_done_to_it_is_noticed"),
    ),
    *_of(
        "platform/upkeep/doctor",
        ("the doctor reads hashes", "if not files.is_whole(row.sha256, row.size, hashes)]",
         "if not files.is_whole(row.sha256, row.size, False)]",
         f"{BACKUP}::test_the_doctor_finds_what_is_missing_damaged_or_standing_open"),
        ("the doctor finds jobs that nobody works on", "    stuck = bool(live) and not workers\n", "    stuck = False\n",
         f"{DOCTOR}::test_jobs_that_nobody_works_on_are_found"),
        ("the doctor finds a disk that is nearly full", "    ok = free >= LEAST_FREE_MB\n", "    ok = True\n",
         f"{DOCTOR}::test_a_disk_that_is_nearly_full_is_found"),
        ("the doctor finds a clock that goes wrong", "    ok = apart <= MOST_CLOCK_DIFFERENCE_S\n", "    ok = True\n",
         f"{DOCTOR}::test_a_clock_of_the_database_that_goes_wrong_is_found"),
        ("the doctor sees folders that stand open", "f.is_dir() and f.stat().st_mode & 0o077]", "False]",
         f"{BACKUP}::test_the_doctor_finds_what_is_missing_damaged_or_standing_open"),
    ),
    *_of(
        "ingest/uploads/service",
        ("an upload that a full disk cut short is told so", "        if beneath is not None:\n            self.status,",
         "        if False:\n            self.status,",
         f"{INTERRUPTED}::test_a_fault_after_the_bytes_are_safe_tells_so_and_is_mended_without_a_restart"),
        ("a full disk leaves no upload without sessions", "        if passing(fault) is not None:\n            raise  # they are made",
         "        if False:\n            raise  # they are made",
         f"{INTERRUPTED}::test_a_disk_that_stays_full_is_no_fault_of_the_file"),
    ),
    *_of(
        "ingest/uploads/receiving",
        ("a full disk is no fault of the file", "            if passing(fault) is not None:\n", "            if False:\n",
         f"{INTERRUPTED}::test_a_disk_that_stays_full_is_no_fault_of_the_file"),
    ),
    *_of(
        "ingest/uploads/in_progress",
        ("a full disk counts against no file", "                take_back()\n", "                pass\n",
         f"{INTERRUPTED}::test_a_disk_that_stays_full_is_no_fault_of_the_file"),
        ("a database that dies hides nothing that is kept", "            with suppress(DBAPIError):\n", "            if True:\n",
         f"{INTERRUPTED}::test_a_database_that_dies_during_an_upload_does_not_hide_what_is_kept"),
    ),
    *_of(
        "platform/errors",
        ("a full disk is told as one", "if isinstance(error, OSError) and error.errno in FULL:", "if False:",
         f"{HEALING}::test_what_fails_beneath_is_told_in_true_words"),
        ("a database that is away is told as one", "    if invalidated or unreached or state[:2] in _AWAY or state[:3] in _AWAY:\n",
         "    if False:\n", f"{HEALING}::test_what_fails_beneath_is_told_in_true_words"),
    ),
    *_of(
        "platform/upkeep/commands",
        ("the doctor ends with exit code 1 where something is wrong", "    if not all(f.ok for f in findings):\n", "    if False:\n",
         f"{DOCTOR}::test_the_exit_code_is_1_and_the_lines_say_what_is_wrong"),
    ),
    *_of(
        "platform/database",
        ("an answer stands whose database goes away", "        if passing(error) is None:\n            raise\n        log.warning",
         "        raise\n        log.warning", f"{HEALING}::test_an_answer_stands_whose_database_goes_away_after_it_was_made"),
    ),
    *_of(
        "platform/logs",
        ("a log on a full disk costs no answer", "        with suppress(OSError):\n            self._stream.write(text)\n",
         "        self._stream.write(text)\n", "tests/app/platform/test_logs.py::test_a_log_on_a_full_disk_loses_lines_and_no_answers"),
    ),
    *_of(
        "platform/jobs/children/child",
        ("a step on a full disk says so", 'return "full" if error.errno in FULL else "error"', 'return "error"',
         "tests/app/platform/jobs/test_children.py::test_a_full_disk_is_told_from_a_fault_of_the_step"),
        at_start=True,
    ),
    *_of(
        "platform/web/middleware",
        ("requests from other sites are refused", "    refused = _cross_site(request)\n", "    refused = None\n",
         f"{SIGN_IN}::test_posts_from_another_site_are_refused"),
        ("a cookie beside a token is judged too", "and bool(token.strip()) and not request.cookies", "and bool(token.strip())",
         f"{SIGN_IN}::test_an_authorization_header_beside_the_cookie_lets_no_other_site_in"),
        ("every answer forbids sniffing", '    response.headers["X-Content-Type-Options"] = "nosniff"\n', "",
         f"{HEADERS}::test_every_answer_has_them"),
        ("HTTPS is demanded of browsers", '        response.headers["Strict-Transport-Security"] = "max-age=31536000"\n', "        pass\n",
         f"{HEADERS}::test_every_answer_has_them"),
    ),
    *_of(
        "platform/web/body_limit",
        ("strangers send nothing large", ", await self.judge(request)])", "])",
         f"{LIMITS}::test_a_gibibyte_of_nobody_is_refused_before_it_is_received"),
        ("nothing that the interface is sent is read of strangers", 'is_json(scope) or scope["path"].startswith(INTERFACE)', "False",
         f"{MALFORMED}::test_no_body_of_nobody_is_read"),
        ("JSON of strangers is read nowhere", 'is_json(scope) or scope["path"]', 'scope["path"]',
         f"{MALFORMED}::test_json_of_nobody_is_read_by_no_page_either"),
        ("bodies without a length are cut off", "        if self._seen > self._limit:\n", "        if False:\n",
         f"{BODIES}::test_a_document_that_states_no_length_is_cut_off"),
    ),
    *_of(
        "platform/web/schemas",
        ("bounds are published as readers know them", "if described.get(bound) == limit:", "if bound in described:",
         f"{NUMBERS}::test_bounds_beside_null_and_of_items_are_those_of_a_json_schema"),
    ),
    *_of(
        "main",
        ("what no body can be is documented", "        found |= {400}\n", "        pass\n",
         f"{MALFORMED}::test_answers_that_stand_before_every_route_are_described"),
        ("a full disk is documented", "        found |= {507}\n", "        pass\n",
         f"{MALFORMED}::test_answers_that_stand_before_every_route_are_described"),
        at_start=True,
    ),
    *_of(
        "accounts/browser",
        ("one source fails a hundred times at most", "    if wait_s := failed_sign_ins.take(source):\n", "    if wait_s := 0:\n",
         f"{LIMITS}::test_many_accounts_tried_from_one_address_are_refused_in_words"),
        ("cookies are out of reach of scripts", "httponly=True", "httponly=False",
         f"{SIGN_IN}::test_the_cookie_is_out_of_reach_of_scripts_and_other_sites"),
    ),
    *_of(
        "study/data_queries/service",
        ("what one asks, another answers", "can.WRITE_STUDY if given.state is QueryState.ANSWERED else can.ASK_QUERIES", "can.READ",
         f"{PAGES}::test_every_form_against_every_role"),
    ),
]  # fmt: skip
