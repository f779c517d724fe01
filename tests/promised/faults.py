"""Promises about processes that die, disks that fill and installations that are not in order; a part of `tests/promises.py`."""

from __future__ import annotations

from tests.promised.promise import Promise
from tests.promised.promise import of as _of

INTERRUPTED = "tests/app/ingest/uploads/test_interrupted.py"
HEALING, DOCTOR = "tests/app/platform/test_healing.py", "tests/app/platform/upkeep/test_doctor.py"

FAULTS = [
    Promise("the compose file leaves cookies to HTTPS", "docker-compose.yml", "      BETALOOP_COOKIE_SECURE:\n",
            "      BETALOOP_COOKIE_SECURE: ${BETALOOP_COOKIE_SECURE:-false}\n",
            "tests/test_compose.py::test_people_sign_in_over_https_alone_unless_somebody_says_otherwise", at_start=True),
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
        "ingest/uploads/interrupted",
        ("nothing new is taken where a study has ended", "if why := why_left(participant):", "if why := '':",
         f"{INTERRUPTED}::test_what_was_cut_short_waits_while_nothing_new_is_taken"),
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
        ("a database that dies hides nothing that is kept", "            except DBAPIError:\n", "            except ImportError:\n",
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
        "platform/database/__init__",
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
        "platform/upkeep/doctor",
        ("the doctor finds jobs that nobody works on", "    if live and not workers:\n", "    if False:\n",
         f"{DOCTOR}::test_jobs_that_nobody_works_on_are_found"),
        ("the doctor finds a disk that is nearly full", "    ok = free >= LEAST_FREE_MB\n", "    ok = True\n",
         f"{DOCTOR}::test_a_disk_that_is_nearly_full_is_found"),
        ("the doctor finds a clock that goes wrong", "    ok = apart <= MOST_CLOCK_DIFFERENCE_S\n", "    ok = True\n",
         f"{DOCTOR}::test_a_clock_of_the_database_that_goes_wrong_is_found"),
    ),
]  # fmt: skip
