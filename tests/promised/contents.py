"""Promises about what is uploaded, made elsewhere, bundled, planned, released and signed; a part of `tests/promises.py`."""

from __future__ import annotations

from tests.promised.promise import Promise, of

BUCKET = "tests/app/ingest/safety/test_files_in_a_bucket.py"
LETHAL, FILES = "tests/app/ingest/uploads/test_lethal_files.py", "tests/app/ingest/uploads/test_many_files.py"
INCOMING, UPLOADS = "tests/app/ingest/uploads/test_incoming_files.py", "tests/app/ingest/uploads/test_uploads.py"
OVER = "tests/app/ingest/quarantine/test_quarantine.py::test_nothing_new_is_read_for_whom_it_is_over"
FOREIGN = "tests/app/learning/policies/test_foreign_policies.py::test_a_hostile_policy_is_refused_in_words_and_costs_the_service_nothing"
RELEASES, MARGINS = "tests/app/planning/releases/test_releases.py", "tests/app/study/test_margin_signatures.py"
GONE = f"{BUCKET}::test_quarantined_bytes_are_encrypted_there_and_gone_everywhere_once_decided"
IDENTITY = f"{UPLOADS}::test_no_identity_of_a_device_file_is_stored_anywhere"
PACKAGE = "tests/app/overview/test_data_package.py::test_its_own_script_recomputes_the_primary_tables_without_betaloop"
QUERIES = "tests/app/study/data_queries/test_data_queries.py::test_a_query_is_asked_answered_by_a_correction_and_closed"
VISIT_FORM = "tests/app/pages/test_study_pages.py::test_a_visit_is_added_by_form_with_the_amplitude_of_each_side"

CONTENTS: list[Promise] = [
    *of(
        "platform/bucket",
        ("a machine with another key does not start", "            elif self._ask(lambda place=place: self._fs.cat_file(place)) != said:",
         "            elif False:", f"{BUCKET}::test_machines_with_other_keys_do_not_start"),
        ("a machine without the keys of the others makes none", "            if name in known and not (folder / name).exists():",
         "            if False:", f"{BUCKET}::test_machines_with_other_keys_do_not_start"),
    ),
    *of(
        "platform/files",
        ("what a person discards is gone from the bucket", "        store.remove(sha256)\n", "        pass\n", GONE),
        ("without a list of open files the bytes are the owner's alone", "os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600))",
         "os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o644))",
         f"{INCOMING}::test_without_a_list_of_open_files_the_bytes_have_a_name_that_only_the_owner_reads"),
        ("without a list of open files the bytes go too", "            yield file, draft if named else path\n        finally:\n"
         "            draft.unlink(missing_ok=True)\n",
         "            yield file, draft if named else path\n        finally:\n            pass\n",
         f"{INCOMING}::test_without_a_list_of_open_files_the_bytes_have_a_name_that_only_the_owner_reads"),
    ),
    *of(
        "ingest/uploads/receiving",
        ("no machine keeps a copy of quarantined bytes", "files.store(self.db, encryption.encrypt(raw), copy=False)",
         "files.store(self.db, encryption.encrypt(raw))", GONE),
    ),
    *of(
        "ingest/quarantine/service",
        ("nothing new is read at a site that has ended", "    access.refuse_ended(participant.site)\n", "", OVER),
        ("nothing new is read for who has withdrawn", "    access.refuse_withdrawn(participant)\n", "", OVER),
    ),
    *of(
        "ingest/uploads/reading",
        ("the web process reads no file itself", "        return run_limited(reference, dict(params), limits, told, who)\n",
         '        module, _, name = reference.partition(":")\n'
         '        return dict(getattr(__import__(module, fromlist=[name]), name)(dict(params), Path("."), print))\n',
         f"{LETHAL}::test_the_web_process_never_reads_a_file_itself"),
    ),
    Promise("an archive that unpacks to much more than its size is refused", "ml/formats/archive.py",
            "        if total > limits.ratio_applies_above_bytes and total / packed > limits.ratio:\n", "        if False:\n",
            f"{FILES}::test_a_hostile_file_ends_as_a_sentence_and_the_good_one_beside_it_counts", at_start=True),
    Promise("the device's serial number is not in the names of folders", "ml/formats/rcs/redact.py",
            "        return pseudonym(serial, self._key)\n", "        return serial\n", IDENTITY, at_start=True),
    Promise("the device's serial number is in no stored field", "ml/formats/rcs/redact.py",
            "            return self.device(text)\n", "            return text\n", IDENTITY, at_start=True),
    Promise("a policy with operators of others is refused", "ml/policies/onnx_policy.py", "        if node.domain not in known:\n",
            "        if False:\n", FOREIGN, at_start=True),
    Promise("a policy of strangers ends after its time", "app/learning/foreign.py", "memory_mb=1024, cpu_s=10,",
            "memory_mb=1024, cpu_s=40,", FOREIGN, at_start=True),
    Promise("a package recomputes its own tables", "app/overview/recompute.py", "float(np.nanmean(a**2)) if known(a)",
            "float(np.nanmean(a)) if known(a)", PACKAGE, at_start=True),
    *of(
        "study/routes/visits",
        ("a visit's form takes the amplitude of each side",
         "        draft.cdbs_amplitudes = amplitudes({n: typed[n] for n in _FIRST_PROGRAM if n in typed}, confirmed(values, typed))\n",
         "",
         VISIT_FORM),
    ),
    Promise("what people type is text on pages, and no part of them", "app/platform/web/templates.py",
            "autoescape=select_autoescape(default=True)", "autoescape=False",
            VISIT_FORM, at_start=True),
    *of(
        "planning/bundles/service",
        ("the key that is told is the one that signs", "    return signing_key().public_key()",
         "    return Ed25519PrivateKey.generate().public_key()",
         "tests/app/planning/bundles/test_bundles.py::test_a_bundle_is_signed_with_the_key_that_the_service_tells"),
    ),
    *of(
        "planning/plans/sign_off",
        ("the limits of a plan are signed", '        "max_ma": item.max_ma,\n', "",
         "tests/app/planning/plans/test_sign_off.py::test_limits_are_set_with_the_draft_and_signed"),
    ),
    *of(
        "planning/releases",
        ("a release is signed over the policy's bytes", '        "onnx_sha256": policy.onnx_sha256,\n', "",
         f"{RELEASES}::test_a_clinician_releases_a_policy_over_its_bytes_and_limits"),
        ("a release is signed over the policy's checkpoint", '        "checkpoint_sha256": policy.checkpoint_sha256,\n', "",
         f"{RELEASES}::test_any_change_breaks_it_visibly"),
        ("a release is signed over the policy's configuration", '        "config": policy.config,\n', "",
         f"{RELEASES}::test_any_change_breaks_it_visibly"),
    ),
    *of(
        "study/margins",
        ("locked margins are signed over their values",
         "        **{name: getattr(version, name) for name in MarginsFields.model_fields},\n", "",
         f"{MARGINS}::test_a_lock_is_signed_over_its_values"),
    ),
    *of(
        "study/data_queries",
        ("nobody closes a question over words that they have not seen", "    if len(query.entries) != given.entries:\n", "    if False:\n",
         QUERIES),
        ("each word about a value keeps it as it stood",
         "    query.entries.append(_entry(given.state, given.text, query, _found(db, query, caller), caller))\n",
         "    query.entries.append(_entry(given.state, given.text, query, None, caller))\n", QUERIES),
    ),
]  # fmt: skip
