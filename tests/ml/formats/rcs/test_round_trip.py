"""Sessions written by the project's own writer of RC+S folders come back: amplitudes exact, samples and gaps where they were."""

from __future__ import annotations

import io
import json
import zipfile

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from ml.formats import decode
from ml.formats.rcs.beta import time_domain_stretches
from ml.formats.rcs.packets.json_elements import JsonNotes, read_elements
from ml.formats.rcs.packets.scan import scan
from ml.formats.rcs.packets.streams import read_time_domain
from ml.formats.rcs.packets.time import reconstruct
from ml.formats.rcs.settings import Settings, Timeline
from ml.population import PARTICIPANTS, rcs_session_zip, run_session
from ml.population.device.settings import PACKET_SAMPLES

START_MS = 1_700_000_000_000
LEAD = 3
LFP_START_MS = START_MS + 5_000
SESSION_START_MS = LFP_START_MS + 2_000 * LEAD
PACKET_MS = 4 * PACKET_SAMPLES
EVERYTHING = 10**6


@pytest.fixture(scope="module")
def template():
    return run_session("P1", "random", seed=1, steps=4, resolution_ma=0.1)


def session_like(template, tenths, seed):
    """Build a session with these amplitudes in 0.1 mA and noise for an LFP."""
    cdbs = PARTICIPANTS["P1"].cdbs_amplitude_ma
    steps = len(tenths)
    lfp = np.random.default_rng(seed).normal(0, 0.003, (LEAD + steps) * 500).astype(np.float32)
    beta = np.ones(LEAD + steps)
    amplitude = np.array(tenths) / (10 * cdbs)
    changes = {"lead_beta": beta[:LEAD], "beta": beta[LEAD:], "amplitude": amplitude, "lfp": lfp}
    return type(template)(**{name: changes.get(name, getattr(template, name)) for name in template.__dataclass_fields__})


def packets_of(content):
    """Read time-domain packets of a zip, the index of each in the stream, and its samples; from the device's clock alone."""
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        raw = archive.read(next(name for name in archive.namelist() if name.endswith("RawDataTD.json")))
    packets = json.loads(raw)[0]["TimeDomainData"]
    ms = []
    for packet in packets:
        second = 1000 * packet["Header"]["timestamp"]["seconds"]
        ms.append(next(m for m in range(second, second + 1000) if (10 * m - packet["Header"]["systemTick"]) % 65_536 == 0))
    return raw, packets, np.array(ms)


@given(data=st.data())
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_a_written_session_comes_back(template, tmp_path, data):
    cdbs_tenths = round(10 * PARTICIPANTS["P1"].cdbs_amplitude_ma)
    tenths = data.draw(st.lists(st.integers(0, cdbs_tenths), min_size=4, max_size=12), label="tenths of mA")
    seed = data.draw(st.integers(0, 1000), label="seed")
    loss = data.draw(st.sampled_from([0.0, 0.03, 0.15]), label="loss")
    offset_s = data.draw(st.integers(-(10**8), 10**8), label="implant's clock ahead, s")
    bad = data.draw(st.sampled_from([0, 3, 15, EVERYTHING]), label="packets without PacketGenTime")
    made = session_like(template, tenths, seed)
    content = rcs_session_zip(made, started_ms=START_MS, packet_loss=loss, seed=seed, ins_clock_offset_s=offset_s, bad_gen_times=bad)
    raw, packets, ins_ms = packets_of(content)
    late_ms = 250 if bad == EVERYTHING else 50  # placed by the times of arrival, else by PacketGenTime

    path = tmp_path / "s.zip"
    path.write_bytes(content)
    (recording,) = decode(path).recordings
    start_ms = recording.started_at.timestamp() * 1000
    first_ms = LFP_START_MS + (ins_ms[0] - round(1000 * (offset_s - 951_868_800)) - LFP_START_MS) - PACKET_MS
    assert abs(start_ms - first_ms) < late_ms + (PACKET_MS if loss else 0)

    changes = [(START_MS + 1_500, cdbs_tenths)]
    for k, wanted in enumerate([*tenths, cdbs_tenths]):
        if wanted != changes[-1][1]:
            changes.append((SESSION_START_MS + 2_000 * k, wanted))
    logged = [(e.t_s * 1000 + start_ms, e.data["delivered_ma"][0]) for e in recording.events if e.kind == "stimulation"]
    np.testing.assert_allclose([t for t, _ in logged], [t for t, _ in changes], atol=1.0)
    assert [a for _, a in logged] == [a / 10 for _, a in changes]

    amplitude = next(t for t in recording.traces if t.stream == "amplitude")
    fine = start_ms + 2.0 * np.arange(1000 * amplitude.values.size) + 1.0  # 2 ms steps, each at its middle
    held = np.array([a / 10 for _, a in changes])[np.searchsorted([t for t, _ in changes], fine, side="right") - 1]
    covered = fine < start_ms + 1000 * recording.duration_s
    expected = [np.mean(h[c]) if c.any() else np.nan for h, c in zip(held.reshape(-1, 1000), covered.reshape(-1, 1000), strict=True)]
    np.testing.assert_allclose(amplitude.values[amplitude.valid], np.array(expected)[amplitude.valid], atol=0.01)

    index = np.rint((ins_ms - ins_ms[0]) / PACKET_MS).astype(int)
    assert recording.quality["time_domain"]["packets"] == len(packets)
    assert recording.quality["time_domain"]["missing"] == index[-1] + 1 - len(packets)

    read = read_time_domain(batch for batch, _ in read_elements(io.BytesIO(raw), JsonNotes(), scan))
    times = reconstruct(read.headers)
    np.testing.assert_allclose(times.last_ms - times.last_ms[0], ins_ms - ins_ms[0], atol=2 * late_ms)
    stretches = time_domain_stretches(read, times, Settings(Timeline(), Timeline(), {}, False))["key 0"]
    runs = np.split(np.arange(index.size), np.flatnonzero(np.diff(index) != 1) + 1)
    written = [np.concatenate([packets[i]["ChannelSamples"][0]["Value"] for i in run]) for run in runs]
    assert len(stretches) == len(runs)
    for (begun_ms, rate, samples), run, values in zip(stretches, runs, written, strict=True):
        assert rate == 250.0
        np.testing.assert_array_equal(samples, values)
        assert abs(begun_ms - (start_ms + PACKET_MS * index[run[0]])) < 2 * late_ms
