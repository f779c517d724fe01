from __future__ import annotations

import json
import zipfile

import numpy as np
import pytest

from ml.formats import decode, sniff
from ml.formats.loose import Opening, group
from ml.formats.rcs.opening import read_opening
from ml.formats.rcs.redact import redact_rcs_zip


@pytest.mark.parametrize("name", ["stim_sweep", "embedded_adaptive", "montage_packet_loss", "empty_streams"])
def test_every_real_file_that_holds_a_record_is_known_by_its_content(recordings, name):
    with zipfile.ZipFile(recordings / f"rcs/{name}.zip") as archive:
        found = {n.rsplit("/")[-1][:-5]: read_opening(archive.read(n)[: 1 << 16]) for n in archive.namelist() if n.endswith(".json")}
    assert {stem: o.stem for stem, o in found.items() if not o.empty} == {stem: stem for stem, o in found.items() if not o.empty}
    assert len({(o.device, o.session) for o in found.values() if not o.empty}) == 1
    assert all(o.nameless for o in found.values() if o.empty)


@pytest.mark.parametrize(
    "text",
    [
        '{"BrainSenseTimeDomain":[{"TimeDomainData":[1]}],"EventSummary":{"RecordInfo":{}}}',
        '[{"RecordInfo":' + "[" * 2000,
        "t_s,beta\n1,2",
        '[{"RecordInfo":{"DeviceId":5,"SessionId":""}}]',
        '[{"RecordInfo":{"DeviceId":"\\ud800","SessionId":"a;b"}}]',
    ],
)
def test_what_is_no_rcs_file_tells_nothing(text):
    assert read_opening(text.encode()) == Opening()


def test_files_are_grouped_by_what_they_name_and_never_mixed():
    a, b, c = (Opening("StimLog", *key) for key in (("A", "1"), ("B", "1"), ("A", "2")))
    assert group([a, a, Opening(), Opening(empty=True)]).recordings == [[0, 1, 2, 3]]
    assert group([a, b, a]).recordings == [[0, 2], [1]]
    assert group([a, c, a]).recordings == [[0, 2], [1]]
    assert group([a, b, Opening("StimLog", "B")]).recordings == [[0], [1, 2]]
    mixed = group([a, b, Opening(), Opening(empty=True)])
    assert (mixed.recordings, mixed.homeless) == ([[0], [1], [2]], [3])
    assert group([a, c, Opening("StimLog", "A")]).recordings == [[2], [0], [1]]
    assert group([Opening(), Opening(empty=True)]).recordings == [[0, 1]]


def in_one_folder(rcs, other):
    """Put settings and stimulation of an implant or session named by `other` next to a time domain of the usual one."""
    files = {
        "RawDataTD": rcs.time_domain(np.full(5000, 0.01)),
        "DeviceSettings": rcs.settings(),
        "StimLog": rcs.stim((0, rcs.program(1.0))),
    }
    for stem in ("DeviceSettings", "StimLog"):
        for record in files[stem]:
            record["RecordInfo"] |= other
    return {f"DeviceX/{stem}.json": content for stem, content in files.items()}


@pytest.mark.parametrize("other", [{"DeviceId": "NPC700000H"}, {"SessionId": "1700000009999"}])
def test_a_folder_of_two_implants_or_sessions_is_two_recordings_before_and_after_cleaning(rcs, pack, tmp_path, other):
    source, target = pack(in_one_folder(rcs, other)), tmp_path / "r.zip"
    decoded = decode(source)
    assert len(decoded.recordings) == 2
    assert not any({"beta", "amplitude"} <= {t.stream for t in r.traces} for r in decoded.recordings)
    assert any("2 implants or sessions" in said for said in decoded.reports[0].flagged)
    done = redact_rcs_zip(source, target, b"a key of the clinic's own")
    assert any("2 implants or sessions" in said for said in done.repaired)
    assert sorted(r.fingerprint for r in decode(target).recordings) == sorted(r.fingerprint for r in decoded.recordings)


def test_files_of_an_archive_under_other_names_are_known_by_their_content(rcs, pack):
    files = in_one_folder(rcs, {})
    usual = decode(pack(files)).recordings[0].fingerprint
    renamed = pack({name.replace(".json", " (1).json"): json.dumps(content) for name, content in files.items()}, "renamed.zip")
    assert sniff(renamed) == "rcs"
    assert [r.fingerprint for r in decode(renamed).recordings] == [usual]


def test_of_two_files_of_one_kind_the_one_with_the_devices_name_counts_and_the_other_is_said(rcs, pack):
    files = in_one_folder(rcs, {})
    usual = decode(pack(files)).recordings[0].fingerprint
    files["DeviceX/A copy.json"] = rcs.time_domain(np.full(500, 0.02))
    decoded = decode(pack(files, "twice.zip"))
    assert [r.fingerprint for r in decoded.recordings] == [usual]
    assert any("RawDataTD stands more than once" in said for said in decoded.reports[0].ignored)
