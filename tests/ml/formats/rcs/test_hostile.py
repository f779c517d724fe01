"""Files made to harm: each costs itself at most, never the process or its memory."""

from __future__ import annotations

import json
import math
import subprocess
import sys
import tracemalloc
from itertools import pairwise

import numpy as np
import pytest

from ml.formats import decode
from ml.formats.rcs import folder as rcs_module
from ml.formats.rcs.redact import redact_rcs_zip

KEY = b"a key of the clinic's own"
FOLDER = "DeviceNPC799999H/"
STEMS = [
    "DeviceSettings",
    "StimLog",
    "EventLog",
    "AdaptiveLog",
    "ErrorLog",
    "RawDataTD",
    "RawDataPower",
    "RawDataAccel",
    "RawDataFFT",
    "TimeSync",
]
NESTED = "[" * 100_000 + "]" * 100_000
HARM = {
    "deep lists": '[{"RecordInfo":' + NESTED + "}]",
    "deep objects": '[{"RecordInfo":{},"x":' + '{"x":' * 900 + "1" + "}" * 900 + "}]",
    "moderately deep": '[{"RecordInfo":{},"TherapyConfigGroup0":' + '{"x":' * 200 + "1" + "}" * 200 + "}]",
    "no numbers": '[{"RecordInfo":{"HostUnixTime":NaN},"AmplitudeLimitsGroup0":{"prog0LowerInMilliamps":INF,"x":-Infinity}}]',
    "huge numbers": '[{"RecordInfo":{"HostUnixTime":1e999},"UtcOffset":' + "9" * 5000 + "}]",
    "byte order mark": "\ufeff[]",
    "other alphabet": '[{"RecordInfo":{"HostUnixTime":"\u0968"}}]',
    "lone surrogate": '[{"RecordInfo":{"DeviceId":"\\ud800"}}]',
    "null bytes": "\0" * 5000,
    "only openings": "[{" * 5000,
    "only quotes": '["' * 5000,
    "long key": '[{"' + "x" * 100_000 + '":1}]',
}


def session(rcs, **other):
    sine = 0.02 * np.sin(2 * np.pi * 22 * np.arange(5000) / 500)
    files = {
        "DeviceSettings": rcs.settings(),
        "RawDataTD": rcs.time_domain(sine),
        "StimLog": rcs.stim((-4, {"therapyStatusData": {"therapyStatus": 1, "activeGroup": 0}, **rcs.program(1.0)})),
    }
    return {f"{FOLDER}{stem}.json": value for stem, value in (files | other).items()}


@pytest.mark.parametrize("harm", HARM.values(), ids=HARM.keys())
def test_harm_in_any_file_leaves_the_others_decoded_and_redacted(rcs, pack, tmp_path, harm):
    for stem in STEMS:
        source, clean = pack(session(rcs, **{stem: harm.encode("utf-8", "surrogatepass")}), f"{stem}.zip"), tmp_path / "clean.zip"
        redact_rcs_zip(source, clean, KEY)
        for path in (source, clean):
            (recording,) = decode(path).recordings
            if stem != "RawDataTD":
                beta = next(t for t in recording.traces if t.stream == "beta")
                np.testing.assert_allclose(beta.values, 20 / math.sqrt(2), rtol=0.01)


@pytest.mark.parametrize("stem", ["RawDataTD", "RawDataPower", "RawDataAccel", "RawDataFFT", "TimeSync"])
def test_packets_with_absurd_numbers_never_stop_the_decoder(rcs, pack, stem):
    rng = np.random.default_rng(0)
    absurd = [0, -1, 2**47, -(2**47), 1e300, -1e300, 0.5, 65_535, 1e-300]
    packets = []
    for _ in range(300):
        a, b, c, d, e = (absurd[i] for i in rng.integers(0, len(absurd), 5))
        packets.append(
            {
                "Header": {"dataTypeSequence": a, "systemTick": b, "timestamp": {"seconds": c}},
                "PacketGenTime": d,
                "PacketRxUnixTime": e,
                "ChannelSamples": [{"Key": 0, "Value": [a, b]}],
                "Bands": [a, b, c, d, e, a, b, c],
                "ValidDataMask": a,
                "FftOutput": [a, b, c],
                "FftSize": 1,
                "Channel": 0,
                "SampleRate": 1,
                **{axis: [a, b] for axis in ("XSamples", "YSamples", "ZSamples")},
            }
        )
    key = rcs_module.KEY_OF[stem]
    decoded = decode(pack(session(rcs, **{stem: [{"RecordInfo": {}, key: packets}]})))
    assert len(decoded.recordings) == 1
    assert any(r.name == f"{stem}.json" and "300 packets" in r.understood for r in decoded.reports)


def test_records_without_end_are_counted_and_not_kept(rcs, pack, monkeypatch):
    monkeypatch.setattr(rcs_module, "MAX_RECORDS", 1_000)
    flood = json.dumps([{"RecordInfo": {"HostUnixTime": 1}}] * 20_000)
    path = pack(session(rcs, ErrorLog=flood, DeviceSettings=flood))
    tracemalloc.start()
    decoded = decode(path)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 15e6
    assert decoded.recordings[0].quality["errors"] == 20_000
    assert any("more than 1000 records" in text for r in decoded.reports for text in r.flagged)


def test_samples_beyond_what_the_device_can_stream_are_left_out_and_said(rcs, pack, monkeypatch):
    monkeypatch.setattr(rcs_module, "MAX_NUMBERS", 3_000)
    text = json.dumps(rcs.time_domain(np.full(5000, 0.01)))
    path = pack(session(rcs, RawDataTD=text.replace('"DebugInfo": 0', '"DebugInfo": null', 60)))  # the first 60 are not plain
    decoded = decode(path)
    about = next(r for r in decoded.reports if r.name == "RawDataTD.json")
    assert decoded.recordings[0].quality["time_domain"]["packets"] == 60
    assert any("40 packets at its end were left out" in text for text in about.flagged)


def packet_ends(text):
    """Find where each packet of a stream ends in the text of its file."""
    starts = [i for i in range(len(text)) if text.startswith('{"Header"', i)]
    return [b - 2 for _, b in pairwise(starts)] + [len(text) - 3]


def test_wherever_a_session_is_cut_every_complete_packet_is_kept(rcs, pack, tmp_path):
    text = json.dumps(rcs.time_domain(np.round(0.02 * np.sin(np.arange(2000)), 6)))
    ends = packet_ends(text)
    rng = np.random.default_rng(0)
    for cut in [*rng.integers(300, len(text), 25).tolist(), *(e for e in ends[3:6]), *(e + 1 for e in ends[3:6]), len(text) - 1]:
        source, clean = pack(session(rcs, RawDataTD=text[:cut]), "cut.zip"), tmp_path / "clean.zip"
        redact_rcs_zip(source, clean, KEY)
        for path in (source, clean):
            quality = decode(path).recordings[0].quality
            complete = sum(end <= cut for end in ends)
            assert quality.get("time_domain", {"packets": 0})["packets"] == complete


@pytest.mark.slow
def test_a_time_domain_of_100_mb_is_decoded_in_less_than_400_mb():
    found = subprocess.run([sys.executable, "-c", PEAK], check=True, capture_output=True, text=True, timeout=170)
    assert float(found.stdout.split()[-1]) < 400


PEAK = """
import sys, tempfile
from pathlib import Path
sys.path.insert(0, "benchmarks")
import ingest
with tempfile.TemporaryDirectory() as folder:
    ingest.time_domain_file(Path(folder) / "RawDataTD.json", 100)
    print(ingest.whole_decode_peak_mb(Path(folder)))
"""


def test_samples_that_no_electrode_gives_are_gaps_and_told(rcs, pack):
    x = 0.003 * np.sin(2 * np.pi * 20 * np.arange(30_000) / 500)
    whole = decode(pack(session(rcs, RawDataTD=rcs.time_domain(x))))
    x[1100:1200] = 1e6
    found = decode(pack(session(rcs, RawDataTD=rcs.time_domain(x))))
    clean, spoilt = (next(t for t in d.recordings[0].traces if t.stream == "beta") for d in (whole, found))
    assert clean.valid.all()
    assert spoilt.valid.all(), "a tenth of a step is missing"
    assert np.abs(spoilt.values - clean.values).max() < 0.05 * clean.values.max()
    assert "100 samples beyond 100 mV, which no electrode gives: gaps" in [text for r in found.reports for text in r.flagged]
    assert not any("no electrode" in text for r in whole.reports for text in r.flagged)
