from __future__ import annotations

import numpy as np
import pytest

from ml.formats import DecodeOptions
from ml.formats.rcs import beta as rcs_beta
from ml.formats.rcs.beta import band_rows_in_blocks, flat_share, time_domain_stretches
from ml.formats.rcs.packets.streams import TimeDomain
from ml.formats.rcs.packets.time import PacketHeaders, PacketTimes
from ml.formats.rcs.settings import Sensing, Settings, Timeline
from ml.formats.rcs.traces import Grid
from ml.signals import band_rows

RATE = 250.0
NO_SETTINGS = Settings(Timeline(), Timeline(), {}, False)


def placed(last_ms, counts, chunk, samples=None, key=0):
    """Build packets of one key whose last samples are at `last_ms`."""
    counts = np.array(counts)
    n = counts.size
    nothing = np.zeros(n)
    head = PacketHeaders(nothing, nothing, nothing, nothing, nothing, counts, np.full(n, RATE))
    x = np.arange(counts.sum(), dtype=np.float64) if samples is None else samples
    empty, absent = np.empty(0), np.full(n, -1)
    data = TimeDomain(
        head,
        tuple(x if k == key else empty for k in range(4)),
        tuple(np.cumsum(counts) - counts if k == key else absent for k in range(4)),
        0,
    )
    return data, PacketTimes(np.array(last_ms, dtype=np.float64), np.array(chunk), False, 0)


def stretches(*arguments, settings=NO_SETTINGS, **named):
    return time_domain_stretches(*placed(*arguments, **named), settings)


def test_packets_of_a_chunk_are_one_stretch_from_their_first_sample_on():
    ((start, rate, x),) = stretches([40, 80, 120], [10, 10, 10], [0, 0, 0])["key 0"]
    assert (start, rate, x.tolist()) == (4.0, RATE, list(range(30)))


def test_chunks_without_a_missing_sample_between_them_are_one_stretch_and_others_are_not():
    found = stretches([40, 80, 124], [10, 10, 10], [0, 1, 2])["key 0"]
    assert [(start, x.tolist()) for start, _, x in found] == [(4.0, list(range(20))), (88.0, list(range(20, 30)))]


def test_samples_that_were_there_before_count_once():
    found = stretches([40, 60, 40, 100], [10, 10, 5, 5], [0, 1, 2, 3])["key 0"]
    assert [(start, x.tolist()) for start, _, x in found] == [(4.0, [*range(10), *range(15, 20)]), (84.0, [25, 26, 27, 28, 29])]


def test_a_sample_that_is_no_number_is_a_gap():
    x = np.arange(20, dtype=np.float64)
    x[[0, 7, 8]] = np.nan
    found = stretches([40, 80], [10, 10], [0, 0], samples=x)["key 0"]
    assert [(start, part.tolist()) for start, _, part in found] == [(8.0, [1, 2, 3, 4, 5, 6]), (40.0, list(range(9, 20)))]


def test_rejected_packets_are_in_no_stretch_and_late_ones_stand_where_they_were_measured():
    found = stretches([40, np.nan, 120, 80], [10, 10, 10, 10], [0, -1, 0, 0])["key 0"]
    assert [(start, x.tolist()) for start, _, x in found] == [(4.0, [*range(10), *range(30, 40), *range(20, 30)])]


def test_a_change_of_contacts_changes_the_channel():
    sensing = Timeline([0.0, 100.0], [Sensing(contacts=("+2-0",) * 4), Sensing(contacts=("+3-1",) * 4)])
    found = stretches([40, 80, 120], [10, 10, 10], [0, 0, 0], settings=Settings(sensing, Timeline(), {}, False))
    assert {name: [x.size for _, _, x in parts] for name, parts in found.items()} == {"key 0 +2-0": [20], "key 0 +3-1": [10]}


@pytest.mark.parametrize("band", [(13.0, 35.0), (18.6, 22.5)])
def test_beta_in_blocks_equals_beta_of_whole_stretches(monkeypatch, band):
    monkeypatch.setattr(rcs_beta, "ROWS_AT_ONCE", 4)
    rng = np.random.default_rng(0)
    lengths, gaps = (9000, 30, 4001, 70, 12_000), (0.0, 0.5, 3.0, 0.004, 1.0)
    pieces, at = [], 0.0
    for n, gap in zip(lengths, gaps, strict=True):
        at += gap
        pieces.append((1000.0 * at, RATE, rng.normal(0, 0.003, n)))
        at += n / RATE
    options = DecodeOptions(beta_low_hz=band[0], beta_high_hz=band[1])
    grid = Grid(0.0, at, int(np.ceil(at / 2.0)), options)
    blocks = band_rows_in_blocks(pieces, grid)
    whole = band_rows([(start / 1000.0, rate, 1000.0 * x) for start, rate, x in pieces], grid.rows, 2.0, *band)
    np.testing.assert_allclose(blocks.rms, whole.rms, rtol=1e-9)
    np.testing.assert_allclose(blocks.power, whole.power, rtol=1e-9)
    np.testing.assert_allclose(blocks.covered, whole.covered, atol=1e-12)


def test_the_share_of_flat_samples_counts_over_the_seams_of_blocks(monkeypatch):
    monkeypatch.setattr(rcs_beta, "SAMPLES_AT_ONCE", 7)
    x = np.random.default_rng(0).integers(0, 2, 50).astype(np.float64)
    assert flat_share(x) == np.mean(np.diff(x) == 0)
    assert flat_share(x[:1]) == 0.0
