"""The written device file through the service's own decoder: amplitude exactly, beta within the difference of two filters."""

from __future__ import annotations

import numpy as np
import pytest

from ml.formats import decode
from ml.population import rcs_session_zip, run_session


@pytest.mark.parametrize("packet_loss", [0.0, 0.1])
def test_a_written_recording_is_read_back_as_the_session(tmp_path, packet_loss):
    session = run_session("P2", "random", seed=3, steps=60, resolution_ma=0.1)
    path = tmp_path / "session.zip"
    path.write_bytes(rcs_session_zip(session, started_ms=1_600_000_000_000, packet_loss=packet_loss, ins_clock_offset_s=1e8, seed=1))
    (recording,) = decode(path).recordings
    traces = {trace.stream: trace for trace in recording.traces}
    lead = session.lead_beta.size
    assert traces["amplitude"].unit == "mA"
    assert traces["amplitude"].values[lead:] == pytest.approx(
        session.amplitude * 4.0, abs=0.03
    )  # a row may start up to 20 ms off the command
    assert traces["beta"].unit == "uV"
    ratio = traces["beta"].values / np.concatenate([session.lead_beta, session.beta])
    assert np.nanmean(ratio) == pytest.approx(1, abs=0.03)
    assert np.nanstd(ratio) < 0.12
    assert recording.quality["time_domain"]["loss"] == pytest.approx(packet_loss, abs=0.04)
