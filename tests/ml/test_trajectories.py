"""Alignment of steps, states and rewards, and the stored form of a buffer."""

from __future__ import annotations

import io
import json
from dataclasses import replace

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from ml.designs import Hold
from ml.mdp import MdpSettings
from ml.qoc import Qoc, failed_qoc
from ml.trajectories import ReplayBuffer, SessionTrajectory, content_hash, from_parquet, to_parquet

SETTINGS = MdpSettings(xi_beta=0.5, window=3)


def session(session_id: int = 1, steps: int = 4, **changes: object) -> SessionTrajectory:
    """Build a session whose beta rises by 0.1 per row, so that a row is known by its value; the amplitude of step k is k / 10."""
    whole = SessionTrajectory(
        session_id=session_id,
        visit=1,
        controller="random",
        lead_beta=np.array([-0.2, -0.1, 0.0]),
        beta=0.1 * np.arange(1, steps + 1),
        amplitude=0.1 * np.arange(steps),
        qoc=Qoc(2.0, 7, 10.0),
        random_bound=0.3,
    )
    return replace(whole, **changes)  # type: ignore[arg-type]


def readable_transitions(s: SessionTrajectory) -> list[tuple[list[float], float, float, list[float]]]:
    """Build transitions straight from the definition: s_k is the W betas before row k, a_k, beta and reward belong to row k."""
    out = []
    line = [*s.lead_beta, *s.beta]
    w = len(s.lead_beta)
    for k in range(s.steps):
        beta, a = s.beta[k], s.amplitude[k]
        known = [*line[k : k + w + 1], a]
        if any(np.isnan(known)) or not -1e-4 <= a <= 1 + 1e-4:
            continue
        reward = (0.0 if beta < 0.5 else -1.0) - 0.3 * a
        out.append((line[k : k + w], a, reward, line[k + 1 : k + w + 1]))
    return out


def test_transitions_are_those_of_the_definition() -> None:
    gap, above = session(2, 8), session(3, 8)
    gap.beta[4] = np.nan
    above.amplitude[2], above.amplitude[3] = 1.2, 1.00005
    buffer = ReplayBuffer(SETTINGS, (session(1, 6), gap, above), "uV", "table")
    t = buffer.transitions()
    expected = [row for s in buffer.sessions for row in readable_transitions(s)]
    assert len(t.actions) == len(expected)
    for i, (state, action, reward, following) in enumerate(expected):
        assert t.states[i] == pytest.approx(state)
        assert t.actions[i] == pytest.approx(min(action, 1.0))
        assert t.rewards[i] == pytest.approx(reward, abs=1e-4)
        assert t.next_states[i] == pytest.approx(following)


def test_the_first_state_is_the_window_before_the_session() -> None:
    s = session()
    assert s.states()[0] == pytest.approx([-0.2, -0.1, 0.0])
    assert s.states()[1] == pytest.approx([-0.1, 0.0, 0.1])
    assert s.states().shape == (s.steps + 1, 3)


def test_a_gap_spoils_every_window_that_holds_it_and_no_other() -> None:
    s = session(steps=10)
    s.beta[4] = np.nan
    assert s.usable().tolist() == [True] * 4 + [False] * 4 + [True] * 2


def test_a_window_may_hold_as_many_imputed_values_as_stated_but_not_as_its_newest() -> None:
    s = session(steps=10, most_imputed=1)
    s.beta[4] = np.nan
    # step 4 has no beta, step 5 would have an imputed newest value
    assert s.usable().tolist() == [True] * 4 + [False] * 2 + [True] * 4
    assert np.flatnonzero(s.imputed).tolist() == [3 + 4]
    mean = float(np.nanmean(s.measured_beta))
    low, high = sorted((mean, 0.5))  # between the session's mean and the line from 0.4 to 0.6
    assert low < s.states()[6][1] < high
    assert s.states()[6][[0, 2]] == pytest.approx([0.4, 0.6])
    assert np.isnan(s.states()[5]).tolist() == [False, False, True]
    assert np.isnan(s.rewards(SETTINGS)).tolist() == [False] * 4 + [True] + [False] * 5
    assert ReplayBuffer(SETTINGS, (s,), "uV", "table").transitions().step.tolist() == [0, 1, 2, 3, 6, 7, 8, 9]


def autoregressive(rho: float) -> SessionTrajectory:
    rng = np.random.default_rng(7)
    beta = np.empty(40_000)
    beta[0] = 0.0
    for k in range(1, beta.size):
        beta[k] = rho * beta[k - 1] + rng.standard_normal()
    beta[50::9] = np.nan
    return SessionTrajectory(1, 1, "other", beta[:3], beta[3:], np.zeros(beta.size - 3), most_imputed=1)


@pytest.mark.parametrize("rho", [0.0, 0.5, 0.9])
def test_an_imputed_value_is_the_best_linear_prediction_from_both_neighbours(rho: float) -> None:
    """Of an autoregression of order 1: E[x_t | x_{t-1}, x_{t+1}] = rho (x_{t-1} + x_{t+1}) / (1 + rho^2)."""
    s = autoregressive(rho)
    k = np.flatnonzero(s.imputed)
    measured = s.measured_beta
    expected = rho * (measured[k - 1] + measured[k + 1]) / (1 + rho**2)
    assert k.size > 4000
    assert np.sqrt(np.mean((s.padded_beta[k] - expected) ** 2)) < 0.05 * np.nanstd(measured)


def test_longer_gaps_and_two_gaps_in_one_window_need_a_higher_number() -> None:
    long, two = session(steps=11, most_imputed=1), session(steps=11, most_imputed=1)
    long.beta[[4, 5]] = np.nan
    two.beta[[4, 6]] = np.nan
    assert long.usable().tolist() == [True] * 4 + [False] * 5 + [True] * 2
    assert two.usable().tolist() == [True] * 4 + [False] * 4 + [True] * 3
    assert replace(long, most_imputed=2).usable().tolist() == [True] * 4 + [False] * 3 + [True] * 4


def test_nothing_is_imputed_before_the_first_value_nor_with_none_allowed() -> None:
    s = session(steps=6, lead_beta=np.array([0.1, np.nan, np.nan]), most_imputed=1)
    assert not s.imputed.any()
    assert s.usable().tolist() == [False] * 3 + [True] * 3
    assert not session().imputed.any()


def test_windows_cannot_be_imputed_altogether() -> None:
    with pytest.raises(ValueError, match="3 imputed values of 3"):
        session(most_imputed=3)


def test_imputed_values_are_not_stored_but_their_number_is() -> None:
    s = session(steps=10, most_imputed=1)
    s.beta[4] = np.nan
    again = from_parquet(to_parquet(ReplayBuffer(SETTINGS, (s,), "uV", "table"))).sessions[0]
    assert np.isnan(again.beta[4])
    assert again.usable().tolist() == s.usable().tolist()


def test_a_session_without_a_lead_can_be_used_from_step_w_on() -> None:
    s = session(steps=6, lead_beta=np.full(3, np.nan))
    assert s.usable().tolist() == [False] * 3 + [True] * 3


def test_an_amplitude_above_cdbs_stays_out() -> None:
    s = session()
    s.amplitude[1] = 1.01
    assert s.usable().tolist() == [True, False, True, True]


def test_a_buffer_without_a_usable_step_says_so() -> None:
    s = session(lead_beta=np.full(3, np.nan), steps=2)
    with pytest.raises(ValueError, match="no usable step"):
        ReplayBuffer(SETTINGS, (s,), "uV", "table").transitions()


def test_the_stored_form_keeps_everything_and_its_hash() -> None:
    buffer = ReplayBuffer(SETTINGS, (session(1), session(7, 9, qoc=Qoc(), random_bound=None, policy_id=3)), "uV", "table")
    buffer.sessions[1].beta[2] = np.nan
    content = to_parquet(buffer)
    again = from_parquet(content)
    assert content_hash(to_parquet(again)) == content_hash(content)
    assert again.settings == buffer.settings
    assert (again.beta_unit, again.beta_source) == ("uV", "table")
    for a, b in zip(again.sessions, buffer.sessions, strict=True):
        for name in ("lead_beta", "beta", "amplitude"):
            assert np.array_equal(getattr(a, name), getattr(b, name), equal_nan=True)
        assert (a.session_id, a.visit, a.controller, a.policy_id, a.qoc, a.random_bound) == (
            b.session_id,
            b.visit,
            b.controller,
            b.policy_id,
            b.qoc,
            b.random_bound,
        )


def test_the_time_since_a_dose_survives_storing_and_a_buffer_without_it_keeps_its_bytes() -> None:
    known = ReplayBuffer(SETTINGS, (session(1, medication_h=1.5), session(2)), "uV", "table")
    assert [s.medication_h for s in from_parquet(to_parquet(known)).sessions] == [1.5, None]
    assert b"medication_h" not in to_parquet(ReplayBuffer(SETTINGS, (session(1),), "uV", "table"))


def test_held_draws_survive_storing_and_a_buffer_without_them_keeps_its_bytes() -> None:
    holds = (Hold(0, 3, -0.25), Hold(3, 1, None))
    held = ReplayBuffer(SETTINGS, (session(1, holds=holds),), "uV", "table")
    again = from_parquet(to_parquet(held))
    assert again.sessions[0].holds == holds
    assert again.sessions[0].uniform_bound is None
    assert again.sessions[0].random_bound == 0.3
    plain = ReplayBuffer(SETTINGS, (session(1),), "uV", "table")
    assert from_parquet(to_parquet(plain)).sessions[0].uniform_bound == 0.3
    assert b'"schema_version": 1' in to_parquet(plain)
    assert b'"schema_version": 3' in to_parquet(held)


@pytest.mark.parametrize("holds", [(Hold(1, 2, None),), (Hold(0, 2, None), Hold(3, 1, None)), (Hold(0, 5, None),), (Hold(0, 0, None),)])
def test_holds_leave_no_step_out_and_end_with_the_session(holds: tuple[Hold, ...]) -> None:
    with pytest.raises(ValueError, match="leave out steps or go beyond"):
        session(1, holds=holds)


def test_another_file_is_no_snapshot() -> None:
    sink = io.BytesIO()
    pq.write_table(pa.table({"x": [1]}), sink)
    with pytest.raises(ValueError, match="not a betaloop buffer snapshot"):
        from_parquet(sink.getvalue())


def test_a_stopped_session_counts_with_the_worst_outcomes_except_under_cdbs_and_stays_stopped_when_stored() -> None:
    weighted = replace(SETTINGS, c2=10.0, c3=10.0, c4=10.0)
    worst = failed_qoc([Qoc(2.0, 7, 10.0), Qoc(1.5, 9, 0.0)])
    tested, clinical = (session(k, controller=name, stopped_as=worst, qoc=Qoc()) for k, name in ((1, "rl"), (2, "cdbs")))
    assert tested.end_reward(weighted) == 10.0 * 1.5 + 10.0 * 1 - 10.0 * 1
    assert clinical.end_reward(weighted) is None
    assert replace(clinical, qoc=Qoc(2.0, 7, 10.0)).end_reward(weighted) == 89.0
    stored = to_parquet(ReplayBuffer(SETTINGS, (tested, session(3)), "uV", "table"))
    assert [s.stopped_as for s in from_parquet(stored).sessions] == [worst, None]
    plain = to_parquet(ReplayBuffer(SETTINGS, (session(3),), "uV", "table"))
    assert b'"stopped_as"' not in plain


def test_a_buffer_that_says_of_a_session_only_that_it_was_stopped_takes_the_worst_of_its_sessions() -> None:
    stopped = replace(session(1, controller="rl", qoc=Qoc(1.8, 9, 5.0)), stopped_as=Qoc())
    stored = pq.read_table(io.BytesIO(to_parquet(ReplayBuffer(SETTINGS, (stopped, session(3, qoc=Qoc(2.4, 8, 0.0))), "uV", "table"))))
    meta = json.loads(stored.schema.metadata[b"betaloop"]) | {"schema_version": 4}
    del meta["sessions"][0]["stopped_as"]
    meta["sessions"][0]["stopped"] = True
    sink = io.BytesIO()
    pq.write_table(stored.replace_schema_metadata({"betaloop": json.dumps(meta)}), sink)
    assert [s.counted_qoc for s in from_parquet(sink.getvalue()).sessions] == [Qoc(1.8, 1, 100.0), Qoc(2.4, 8, 0.0)]


def test_a_session_that_starts_with_its_recording_begins_at_its_first_window() -> None:
    whole = session(steps=9, lead_beta=np.full(3, np.nan))
    assert not np.isfinite(whole.states()[0]).any()
    cut = whole.from_first_window()
    np.testing.assert_allclose(cut.lead_beta, [0.1, 0.2, 0.3])
    np.testing.assert_allclose(cut.amplitude, 0.1 * np.arange(3, 9))
    assert cut.usable().sum() == whole.usable().sum() == 6
    assert readable_transitions(cut) == readable_transitions(whole)


def test_the_rest_of_a_held_amplitude_stays_from_the_first_window_on() -> None:
    holds = (Hold(0, 2, 0.1), Hold(2, 3, 0.2), Hold(5, 4, 0.3))
    cut = session(steps=9, lead_beta=np.full(3, np.nan), holds=holds).from_first_window()
    assert cut.holds == (Hold(0, 2, 0.2), Hold(2, 4, 0.3))
    np.testing.assert_allclose(cut.lead_beta, [0.1, 0.2, 0.3])


@pytest.mark.parametrize(
    "lead", [np.array([-0.2, -0.1, 0.0]), np.array([-0.2, np.nan, 0.0])], ids=["a whole window", "a gap before the session"]
)
def test_a_recording_that_began_early_enough_is_not_cut(lead: np.ndarray) -> None:
    whole = session(steps=9, lead_beta=lead)
    assert whole.from_first_window() is whole


def test_a_session_without_a_whole_window_soon_is_not_cut() -> None:
    for beta in (np.full(9, np.nan), 0.1 * np.array([1, np.nan, 3, 4, 5, 6, 7, 8, 9])):
        whole = session(steps=9, lead_beta=np.full(3, np.nan), beta=beta)
        assert whole.from_first_window() is whole
