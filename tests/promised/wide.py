"""Promises that wide tests show: whole installations, every route and page, browsers, packaging and documents."""

from __future__ import annotations

from tests.promised.promise import Promise, of

SOAK = "tests/benchmarks/test_soak.py"
ENTRIES, TLS = "tests/browser/test_entries.py", "tests/browser/test_visit_day_tls.py"
ROUTES, TRUST = "tests/app/test_routes.py", "tests/test_trust.py"
EVERY_PAGE = "tests/app/pages/test_every_page.py::test_every_address_of_a_browser_answers_and_every_page_is_small"
SIGN_ON = "tests/app/accounts/test_sign_on.py::test_what_cannot_be_verified_lets_nobody_in"
SECRETS = "tests/app/platform/embedded/test_first_start.py::test_secrets_are_one_for_all_that_start_at_once"
RESTORED = "tests/app/platform/upkeep/test_backup.py::test_a_backup_comes_back_in_another_postgresql"

WIDE: list[Promise] = [
    *of(
        "platform/web/sources",
        ("sign-ins hold up nothing else", "            return await to_thread.run_sync(work, *arguments, limiter=self._limiter)\n",
         "            return work(*arguments)\n",
         "tests/app/accounts/test_many_sign_ins.py::test_static_files_do_not_wait_for_passwords"),
    ),
    *of(
        "accounts/passwords",
        ("passwords that are hard to guess are taken", "    if _guesses(password, [email, name, *words]) < LEAST_GUESSES:\n",
         "    if _guesses(password, [email, name, *words]) < 1000 * LEAST_GUESSES:\n",
         "tests/app/accounts/test_passwords.py::test_what_is_not_is_taken"),
    ),
    *of(
        "accounts/sign_on_provider",
        ("who was asked long ago is not let in", '        if claims["auth_time"] < earliest - LEEWAY_S:\n', "        if False:\n", SIGN_ON),
        ("a time ahead of ours is not believed", '        if claims["auth_time"] > time.time() + LEEWAY_S:\n', "        if False:\n",
         SIGN_ON),
        ("another provider's word is not believed", '"iss": {"essential": True, "value": self.issuer}', '"iss": {"essential": True}',
         SIGN_ON),
        ("what was said to another service is not believed",
         '                    "aud": {"essential": True, "value": self.client_id},\n'
         '                    "nonce": {"essential": True, "value": begun.nonce},\n'
         '                    "auth_time": {"essential": True},\n                },\n'
         '                {"nonce": begun.nonce, "client_id": self.client_id,',
         '                    "nonce": {"essential": True, "value": begun.nonce},\n'
         '                    "auth_time": {"essential": True},\n                },\n'
         '                {"nonce": begun.nonce,', SIGN_ON),
        ("an unsigned word is not believed", "jws.JWSRegistry(algorithms=list(ALGORITHMS),",
         'jws.JWSRegistry(algorithms=[*ALGORITHMS, "none", "HS256"],', SIGN_ON),
        ("what names nobody lets nobody in", "        if not isinstance(subject, str) or not 0 < len(subject) <= 255:\n",
         "        if False:\n",
         SIGN_ON),
    ),
    *of(
        "platform/jobs/stream",
        ("a stream ends with the right to listen", "            if not await run_in_threadpool(_ask, still):\n                return\n",
         "            await run_in_threadpool(_ask, still)\n",
         "tests/app/platform/jobs/test_job_parts.py::test_the_stream_stops_for_whom_may_listen_no_more"),
    ),
    *of(
        "accounts/permissions",
        ("a scope narrows every route", "        if left is not None and permission not in left:\n", "        if False:\n",
         f"{ROUTES}::test_every_route_against_every_scope"),
    ),
    *of(
        "platform/database/__init__",
        ("who wrote stands in the trail", '    db.info["actor"] = {"label": label,', '    db.info["actor"] = {"label": "system",',
         "tests/app/study/test_study_api.py::test_every_write_leaves_an_audit_row_that_cannot_be_changed"),
    ),
    *of(
        "platform/web/compression",
        ("pages are sent compressed", "        await (self.compressed if compress else self.plain)(scope, receive, send)\n",
         "        await self.plain(scope, receive, send)\n", EVERY_PAGE),
    ),
    Promise("no page has a script of its own in it", "app/templates/base.html", "<body data-person=",
            "<script>0</script>\n<body data-person=",
            EVERY_PAGE, at_start=True),
    Promise("every page says who has withdrawn", "app/templates/base.html", 'participant.status == "withdrawn"',
            'participant.status == "gone"',
            "tests/app/study/participation/test_withdrawn_marks.py::test_every_page_of_a_participant_who_has_withdrawn_says_so",
            at_start=True),
    *of(
        "settings",
        ("secrets are for the owner alone", "os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600)", "os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o644)",
         SECRETS),
        ("processes that start at once agree on one secret", "            path.hardlink_to(draft)\n",
         "            path.write_bytes(draft.read_bytes())\n", SECRETS),
        at_start=True,
    ),
    *of(
        "platform/service_role",
        ("the service's role has the rights it needs alone", "f\"grant {', '.join(sorted(rights))} on {target} to {name}\"",
         'f"grant all on {target} to {name}"',
         "tests/app/platform/test_service_role.py::test_the_service_has_the_rights_it_needs_and_no_other"),
        at_start=True,
    ),
    *of(
        "platform/upkeep/backup",
        ("a backup has every stored file", "    count = _restore_files(folder / FILES, key)\n", "    count = 0\n", RESTORED),
        ("a backup that was made around a damaged file comes back", "    known = {*damaged, *manifest", "    known = {*manifest", RESTORED),
        at_start=True,
    ),
    Promise("answers are those of the description", "app/study/routes/api.py",
            'APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))',
            'APIRouter(tags=["study"], responses=problems(401, 403, 422))',
            f"{ROUTES}::test_the_interface_keeps_to_its_own_description", at_start=True),
    Promise("the interface is the recorded one", "app/study/routes/api.py",
            'APIRouter(tags=["study"], responses=problems(401, 403, 404, 422))',
            'APIRouter(tags=["study"], responses=problems(401, 403, 422))',
            "tests/app/test_openapi.py::test_the_interface_is_the_recorded_one", at_start=True),
    *of(
        "platform/web/middleware",
        ("refusals of generated input are answered as described", 'error.status, headers, "application/problem+json")',
         "error.status, headers)",
         "tests/app/test_generated_input.py::test_generated_input_on_rows_that_exist_is_answered_as_described"),
    ),
    Promise("the image installs the lock with hashes", "Dockerfile", "--require-hashes ", "",
            "tests/packages/test_service_lock.py::test_the_image_installs_that_lock_alone", at_start=True),
    Promise("what a document names exists", "docs/trust.md", "`NOT_BROKEN` in `tests/test_trust.py` lists",
            "`NOT_BROKEN` in `tests/test_trusted.py` lists", "tests/test_docs.py::test_what_a_document_names_exists", at_start=True),
    Promise("the rules of bandit are checked", "pyproject.toml", '"S101", "S603", "S607"', '"S101", "S602", "S603", "S607"',
            f"{TRUST}::test_the_rules_of_bandit_are_checked", at_start=True),
    Promise("a promise whose line is gone is noticed", "app/accounts/second_factor.py", "generate_otp(step)", "generate_otp(int(step))",
            f"{TRUST}::test_every_promise_that_is_broken_on_purpose_is_still_there", at_start=True),
    Promise("a named test without a change that breaks it is listed", "tests/promised/trail.py",
            "f\"{LOOKS}::test_files_that_are_sent_for_leave_a_row_too\"",
            'f"{LOOKS}::test_who_looked_at_results_and_who_took_a_file_is_in_the_trail"',
            f"{TRUST}::test_the_tests_without_a_change_that_breaks_them_are_listed", at_start=True),
    Promise("who signs out leaves nothing typed behind", "static/entries.js",
            '  if (form.getAttribute("action") === "/sign-out") { write({ person: "", forms: {} }); return; }\n', "",
            f"{ENTRIES}::test_signing_out_forgets_and_an_expired_sign_in_does_not", at_start=True),
    Promise("nothing is saved under another's name", "app/accounts/deps.py", "if writer is not None and writer != caller.user_id:",
            "if False:",
            f"{ENTRIES}::test_what_one_person_entered_is_never_saved_under_anothers_name", at_start=True),
    Promise("cookies of an installation with HTTPS go over HTTPS alone", "app/accounts/deps.py", "secure=settings.cookie_secure\n",
            "secure=False\n", f"{TLS}::test_over_tls_a_tablet_keeps_entries_and_opens_without_network", at_start=True),
    Promise("a full disk of the database is told as one", "app/platform/errors.py", "    if state == _DISK_FULL:\n", "    if False:\n",
            "tests/app/platform/test_full_disk.py::test_full_disks_are_told_in_words_and_leave_nothing_wrong_behind", at_start=True),
    Promise("no acknowledged entry is lost under load", "app/study/routes/api.py",
            "    row = changes.record_qoc(db, session, values, caller)\n    return QocOut",
            "    row = changes.record_qoc(db, session, values, caller)\n    db.commit = db.flush\n    return QocOut",
            f"{SOAK}::test_under_load_no_request_fails_and_no_write_is_lost", at_start=True),
    Promise("no acknowledged entry is lost by kills", "app/study/routes/api.py",
            "    row = changes.record_qoc(db, session, values, caller)\n    return QocOut",
            "    row = changes.record_qoc(db, session, values, caller)\n    db.commit = db.flush\n    return QocOut",
            f"{SOAK}::test_kills_of_every_process_lose_and_double_nothing", at_start=True),
]  # fmt: skip
