"""The brain kernel against plain Python, scipy and itself in other batches."""

from __future__ import annotations

import math
import subprocess
import sys

import numpy as np
import pytest
from scipy.signal import sosfilt, welch

from ml.designs import Bound
from ml.policies.policy import ProportionalPolicy
from ml.population import PARTICIPANTS, run_session, run_sessions
from ml.population.physiology.brain import (
    BETA_BAND_HZ,
    LFP_RATE_HZ,
    STATE_SIZE,
    STREAM_CORTEX,
    STREAM_LFP,
    advance,
    beta_filter,
    constants_of,
    gauss_pair,
    initial_state,
    saturation,
    seed_streams,
    uniform,
)

WORD = 2**64


def splitmix_output(state: int) -> int:
    z = (state ^ (state >> 30)) * 0xBF58476D1CE4E5B9 % WORD
    z = (z ^ (z >> 27)) * 0x94D049BB133111EB % WORD
    return z ^ (z >> 31)


def test_the_random_stream_is_splitmix64():
    counters = np.zeros((1, 6), dtype=np.uint64)
    counters[0, 2] = 1234567
    state, expected = 1234567, []
    for _ in range(5):
        state = (state + 0x9E3779B97F4A7C15) % WORD
        expected.append(((splitmix_output(state) >> 11) + 0.5) * 2**-53)
    assert splitmix_output((1234567 + 0x9E3779B97F4A7C15) % WORD) == 6457827717110365317  # first output published for this seed
    assert [uniform(counters[0], 2) for _ in range(5)] == expected


def test_normal_draws_have_mean_zero_and_unit_variance_and_streams_are_independent():
    counters = seed_streams(np.array([7], dtype=np.uint64), np.array([1], dtype=np.uint64))
    draws = np.array([[gauss_pair(counters[0], stream) for _ in range(20_000)] for stream in (0, 1)]).reshape(2, -1)
    assert np.abs(draws.mean(axis=1)).max() < 4 / math.sqrt(40_000)
    assert np.abs(draws.var(axis=1) - 1).max() < 4 * math.sqrt(2 / 40_000)
    assert abs(np.corrcoef(draws)[0, 1]) < 4 / math.sqrt(40_000)


def one_period_in_plain_python(participant, counters, state, amplitude, sos):
    """Integrate the equations with whole histories instead of delay lines; returns 500 LFP samples in uV."""
    p = participant.brain
    weights = {"SG": (19.0, 20.0), "GS": (1.12, 10.7), "GG": (6.60, 12.3), "CS": (2.42, 9.2), "XG": (15.1, 139.4)}
    rate = lambda x, m, b: m / (1 + math.exp(-4 * x / m) * (m - b) / b)  # noqa: E731
    s, g = [state[0]] * 8, [state[8]] * 8
    xi, x, background, at_once, lasting = state[16:21]
    target = saturation(amplitude, p.a50, p.hill)
    k_period = p.k0 * math.exp(p.s_act * state[21])
    lfp = []
    for _ in range(500):
        g_x, g_background = gauss_pair(counters, STREAM_LFP)
        white, _ = gauss_pair(counters, STREAM_LFP)
        x = math.exp(-0.004 / 0.4) * x + math.sqrt(1 - math.exp(-0.004 / 0.4) ** 2) * g_x
        decay = math.exp(-0.004 * 2 * math.pi * 3)
        background = decay * background + math.sqrt(1 - decay**2) * g_background
        at_once += (target - at_once) * (1 - math.exp(-0.004 / 0.5))
        lasting += (target - lasting) * (1 - math.exp(-0.004 / (2.0 if target > lasting else 12.0)))
        e = 0.4 * at_once + 0.6 * lasting
        k = k_period * math.exp(p.s_k * x)
        w = {name: healthy + k * (ill - healthy) for name, (healthy, ill) in weights.items()}
        for _ in range(2):
            for draw in gauss_pair(counters, STREAM_CORTEX):
                xi = math.exp(-1 / 5) * xi + 3.0 * math.sqrt(1 - math.exp(-1 / 5) ** 2) * draw
                delayed = lambda history, ms: 0.5 * (history[-1 - ms] + history[-ms])  # noqa: E731
                to_s = rate(w["CS"] * (27 + (1 - 0.3 * e) * xi) - w["GS"] * delayed(g, 6), 300, 17)
                to_g = rate((1 - p.eta * e) * w["SG"] * delayed(s, 6) - w["GG"] * delayed(g, 4) - w["XG"] * 2, 400, 75)
                s.append(to_s + (s[-1] - to_s) * math.exp(-1 / 6))
                g.append(to_g + (g[-1] - to_g) * math.exp(-1 / 14))
        lfp.append(0.5 * (s[-1] - 15) + 0.5 * (background + 0.3 * white))
    return np.array(lfp)


@pytest.mark.parametrize("amplitude", [0.0, 0.4, 1.0])
def test_the_kernel_equals_the_equations_written_out_in_plain_python(amplitude):
    participant = PARTICIPANTS["P3"]
    counters = seed_streams(np.array([11], dtype=np.uint64), np.array([3], dtype=np.uint64))
    constants = constants_of(participant, np.zeros(1))
    state = initial_state(counters, constants, 1.0)
    advance_act = math.exp(-2 / 90)
    own_counters, own_state = counters.copy(), state[0].copy()
    draw, _ = gauss_pair(own_counters[0], 2)
    own_state[21] = advance_act * own_state[21] + math.sqrt(1 - advance_act**2) * draw
    expected = one_period_in_plain_python(participant, own_counters[0], own_state, amplitude, beta_filter())

    beta, lfp = np.empty(1), np.empty((1, 500), dtype=np.float32)
    advance(state, counters, constants, np.array([amplitude]), np.zeros(1), 1.0, beta_filter(), beta, lfp)
    assert lfp[0] == pytest.approx(expected * 1e-3, rel=1e-5, abs=1e-8)
    assert beta[0] == pytest.approx(math.sqrt(np.mean(sosfilt(beta_filter(), expected) ** 2)), rel=1e-9)
    assert state.shape == (1, STATE_SIZE)


def test_beta_is_the_rms_of_the_band_passed_lfp_in_each_window():
    session = run_session("P2", "random", seed=5, steps=40)
    filtered = sosfilt(beta_filter(), session.lfp.astype(np.float64) * 1e3).reshape(-1, 500)
    beta = np.concatenate([session.lead_beta, session.beta])
    assert np.sqrt((filtered**2).mean(axis=1))[2:] == pytest.approx(beta[2:], rel=1e-3)  # the first windows see the filter start


def test_the_off_stimulation_spectrum_peaks_inside_the_beta_band():
    for code in PARTICIPANTS:
        lfp = run_session(code, "no_dbs", seed=1, steps=60).lfp[10_000:]
        frequency, power = welch(lfp, LFP_RATE_HZ, nperseg=500)
        above = frequency > 8
        assert BETA_BAND_HZ[0] < frequency[above][np.argmax(power[above])] < BETA_BAND_HZ[1]


def test_a_session_is_bit_identical_alone_in_a_batch_and_over_threads():
    policy = ProportionalPolicy(1.2, 2.4, floor=0.3, newest=3)
    for controller in (policy, "random"):
        common = {"steps": 30, "keep_lfp": True}
        alone = run_sessions("P4", controller, visits=2, hours=3.1, seeds=[13], **common).session(0)
        visits, hours, seeds = [1, 2, 2, 5, 9], [0.0, 1.0, 3.1, 2.0, 5.0], [1, 2, 13, 4, 5]
        for threads in (1, 2):
            among = run_sessions("P4", controller, visits=visits, hours=hours, seeds=seeds, threads=threads, **common).session(2)
            for name in ("lead_beta", "beta", "amplitude", "lfp"):
                assert np.array_equal(getattr(alone, name), getattr(among, name)), name
            assert alone.qoc == among.qoc
            assert alone.outcomes.tremor_minutes == among.outcomes.tremor_minutes
            assert np.array_equal(alone.outcomes.open_fist_s, among.outcomes.open_fist_s)


def test_a_longer_session_begins_like_a_shorter_one():
    short, long = (run_sessions("P1", "random", seeds=[3], steps=steps) for steps in (20, 40))
    assert np.array_equal(short.amplitude, long.amplitude[:, :20])
    assert np.array_equal(short.beta[:, :15], long.beta[:, :15])  # the grasp test changes the last five steps of the short one


def test_importing_the_cohort_loads_no_compiler():
    code = "import sys, ml.population; ml.population.PARTICIPANTS; assert 'numba' not in sys.modules, 'numba was imported'"
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.parametrize(
    ("asked", "message"),
    [
        (lambda: run_sessions("P9", "cdbs", seeds=[1], steps=5), "no synthetic participant 'P9'"),
        (lambda: run_sessions("P1", "dbs", seeds=[1], steps=5), "no controller 'dbs'"),
        (lambda: run_sessions("P1", "cdbs", seeds=[1], steps=0), "at least one step"),
        (lambda: run_sessions("P1", "random", seeds=[1], steps=5, bound=Bound(1.0)), "lower bound"),
    ],
)
def test_impossible_sessions_are_refused_by_name(asked, message):
    with pytest.raises(ValueError, match=message):
        asked()


def test_a_policy_that_leaves_the_range_or_the_shape_is_refused(timetable):
    with pytest.raises(ValueError, match="outside"):
        run_sessions("P1", timetable([0.5, 1.4]), seeds=[1], steps=2)

    class Wrong:
        def act(self, states):
            return np.zeros((len(states), 1))

    with pytest.raises(ValueError, match="shape"):
        run_sessions("P1", Wrong(), seeds=[1, 2], steps=2)
