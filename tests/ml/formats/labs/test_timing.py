"""Stretches, gaps and rates by the stamps of samples."""

from __future__ import annotations

import numpy as np
import pytest

from ml.formats.labs.timing import Piece, of_pieces, of_stamps


def test_a_gap_of_one_and_a_half_periods_ends_a_stretch_and_a_shorter_one_does_not() -> None:
    t = np.arange(1000) / 250
    t[400:] += 0.6 / 250
    found = of_stamps(t, 250.0)
    assert [p.begin for p in found.pieces] == [0, 400]
    assert (found.gaps, found.lost) == (1, 1)
    assert found.rate_hz == pytest.approx(250)
    t[400:] -= 0.2 / 250
    assert of_stamps(t, 250.0).gaps == 0


def test_losses_below_the_threshold_of_the_library_move_no_other_sample() -> None:
    # five losses of 1.9 s at 250 Hz: pyxdf 1.17.5 spreads them, gives 204 Hz, and 20 Hz reads as 16.3
    there = np.ones(13_000, dtype=bool)
    for k in range(5):
        there[2000 * (k + 1) : 2000 * (k + 1) + 475] = False
    t = np.flatnonzero(there) / 250
    found = of_stamps(t, 250.0)
    assert found.rate_hz == pytest.approx(250, rel=1e-9)
    assert (found.gaps, found.lost) == (5, 5 * 475)
    for p in found.pieces:
        np.testing.assert_allclose(t[p.begin : p.end], p.start_s + np.arange(p.end - p.begin) / found.rate_hz, atol=1e-6)


def test_jitter_of_several_samples_hides_no_loss_and_makes_none() -> None:
    rng = np.random.default_rng(3)
    true = np.arange(20_000) / 250.0
    assert of_stamps(true + rng.uniform(0, 0.012, true.size), 250.0).gaps == 0
    true[9000:] += 25 / 250
    found = of_stamps(true + rng.uniform(0, 0.012, true.size), 250.0)
    assert found.gaps == 1
    assert abs(found.pieces[1].begin - 9000) <= 3
    assert abs(found.lost - 25) <= 1
    assert found.unseen_s > 0
    assert "losses under" in " ".join(found.sentences("LFP"))


def test_a_stated_rate_that_is_wrong_is_replaced_by_that_of_the_times() -> None:
    assert of_stamps(np.arange(5000) / 248.7, 250.0).rate_hz == pytest.approx(248.7, rel=1e-9)


def test_a_clock_that_steps_back_puts_no_sample_twice_at_one_time() -> None:
    t = np.concatenate((np.arange(1000) / 250, 2.0 + np.arange(1000) / 250))
    found = of_stamps(t, 250.0)
    assert found.backward == (pytest.approx(2.0),)
    assert found.dropped == 500
    assert [(p.begin, p.end) for p in found.pieces] == [(0, 1000), (1500, 2000)] or found.pieces[0].end == 1000
    assert any("steps back" in s for s in found.sentences("LFP"))


def test_pieces_without_a_gap_between_them_are_one() -> None:
    found = of_pieces([Piece(0, 10, 0.0), Piece(10, 20, 1.0), Piece(20, 30, 2.5)], 10.0)
    assert [(p.begin, p.end) for p in found.pieces] == [(0, 20), (20, 30)]
    assert (found.gaps, found.lost) == (1, 5)


@pytest.mark.parametrize("t", [np.array([1.0]), np.array([0.0, np.nan, 2.0])])
def test_stamps_that_make_no_signal_are_refused(t: np.ndarray) -> None:
    with pytest.raises(ValueError, match="two samples"):
        of_stamps(t, 250.0)
