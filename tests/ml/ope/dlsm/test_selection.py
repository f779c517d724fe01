"""Held-out free-running prediction, and the choice of settings by it."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest
import torch

from ml.ope.dlsm.batches import make_batch
from ml.ope.dlsm.config import DlsmConfig
from ml.ope.dlsm.estimator import Dlsm
from ml.ope.dlsm.held_out import BLOCK, FreeRuns, SessionError, block_error, shares
from ml.ope.dlsm.selection import SelectionRun, leave_out
from ml.ope.dlsm.training import MemberTraining
from ml.ope.scale import learn_scale
from ml.policies.policy import ConstantPolicy
from ml.trajectories import ReplayBuffer

TINY = DlsmConfig(latent=2, hidden=4, heads=(4,), members=2, steps=10, batch=4, check_every=5, rollouts=12, replay_draws=3)
POLICIES = {"high": ConstantPolicy(0.9), "low": ConstantPolicy(0.4)}


@pytest.fixture(scope="module", autouse=True)
def one_thread():
    before = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(before)


class Interrupted(Exception):
    pass


def run_of(buffer, *candidates, fingerprint="this choice"):
    scale = learn_scale(buffer)
    return SelectionRun(buffer, make_batch(buffer, scale), scale, candidates, 0, fingerprint)


def test_block_errors_are_those_of_block_means_and_leave_gaps_out():
    seen = np.concatenate([np.full(BLOCK, 1.0), np.full(BLOCK, 3.0)])
    seen[3:8] = np.nan
    exact, constant = seen.copy(), np.full(2 * BLOCK, 2.0)
    exact[np.isnan(exact)] = 100.0
    np.testing.assert_allclose(block_error(seen, np.stack([exact, constant])), [0.0, 1.0])


def test_a_block_of_which_little_is_known_counts_only_where_there_is_no_better_one():
    seen = np.full(2 * BLOCK, np.nan)
    seen[:BLOCK], seen[BLOCK + 1] = 1.0, 50.0
    np.testing.assert_allclose(block_error(seen, np.full((1, 2 * BLOCK), 2.0)), [1.0])
    seen[:BLOCK] = np.nan
    np.testing.assert_allclose(block_error(seen, np.full((1, 2 * BLOCK), 2.0)), [48.0**2])
    assert np.isnan(block_error(np.full(40, np.nan), np.zeros((1, 40)))[0])


def error(session, beta, seen, predicted, outcomes=None):
    return SessionError(session, beta, 0.5 * beta, 2 * beta, 1.0, 1.0, outcomes, None if outcomes is None else 1.0, seen, predicted)


def test_every_group_counts_alike_and_the_reward_by_its_better_source():
    found = shares([[error(0, 0.2, 0, 0)] * 9, [error(1, 0.6, 0, 0)]])
    assert (found.beta, found.head, found.known) == pytest.approx((0.4, 0.2, 0.8))
    assert found.outcomes is None
    assert found.contrast is None
    assert found.score == pytest.approx((0.4 + 0.2) / 2)


def test_the_contrast_sees_the_answer_to_the_action_and_not_the_common_level():
    kinds = {0: "cdbs", 1: "random", 2: "no_dbs"}
    seen = {0: -1.0, 1: 0.0, 2: 1.0}

    def contrast(predict):
        return shares([[error(i, 0.1, seen[i], predict(seen[i])) for i in seen]], kinds).contrast

    assert contrast(lambda v: v + 7.0) == pytest.approx(0.0)
    assert contrast(lambda v: 0.0) == pytest.approx(1.0)
    assert contrast(lambda v: 0.5 * v) == pytest.approx(0.25)
    assert contrast(lambda v: -v) == pytest.approx(4.0)


def test_sessions_left_out_neither_train_a_model_nor_stop_it(small_buffer):
    sessions = list(small_buffer.sessions)
    sessions[4] = replace(sessions[4], beta=sessions[4].beta[::-1].copy(), amplitude=sessions[4].amplitude[::-1].copy())
    scale = learn_scale(small_buffer)
    runs = []
    for buffer in (small_buffer, ReplayBuffer(small_buffer.settings, tuple(sessions), "uV", "table")):
        training = MemberTraining(buffer, make_batch(buffer, scale), scale, [0, 5], TINY, 7, "", left_out=[4])
        member = training.run()
        runs.append((member, training.score(training.batch.select([4]), (4,))))
    assert runs[0][0].course == runs[1][0].course
    assert runs[0][1].score != runs[1][1].score
    assert 4 not in training.learnt


def test_every_usable_session_is_left_out_once_per_way_and_whole_controllers_are_one_way(small_buffer):
    groups, kinds = leave_out(small_buffer, seed=0)
    n = len(small_buffer.sessions)
    assert sorted(i for g in groups for i in g) == sorted(i for g in kinds for i in g) == list(range(n))
    assert [{small_buffer.sessions[i].controller for i in g} for g in kinds] == [{"random"}, {"cdbs"}, {"rl"}, {"other"}]
    alone = ReplayBuffer(small_buffer.settings, tuple(s for s in small_buffer.sessions if s.controller == "cdbs") * 2, "uV", "table")
    assert len(leave_out(alone, seed=0)) == 1


def test_the_settings_that_predict_left_out_sessions_better_are_chosen_wherever_they_stand(linear_simulator):
    good = replace(TINY, latent=4, hidden=8, steps=50, learning_rate=1e-2, check_every=25)
    unlearnt = replace(good, steps=1, learning_rate=1e-6)
    found = run_of(linear_simulator.buffer(seed=2, n=8, steps=60), unlearnt, good, unlearnt).run()
    assert found.chosen == 1
    assert found.scores[0] == found.scores[2]
    assert found.scores[1] < 0.9 * found.scores[0]


def test_a_fit_that_chooses_trains_its_members_with_the_chosen_settings_and_shows_the_scores(small_buffer):
    fitted = Dlsm(replace(TINY, select=True)).fit(small_buffer)
    chosen = TINY.candidates()[fitted.selection.chosen]
    assert fitted.config == chosen
    plain = Dlsm(chosen).fit(small_buffer)
    for a, b in zip(fitted.members, plain.members, strict=True):
        assert (a.course, a.check) == (b.course, b.check)
    details = fitted.evaluate(POLICIES, 20)["low"].details
    assert details["objective"] == chosen.objective
    assert details["selection"]["scores"] == pytest.approx(fitted.selection.scores)
    assert min(fitted.selection.scores) == fitted.selection.scores[fitted.selection.chosen]


def test_a_fit_killed_while_it_chooses_or_trains_resumes_to_the_same_numbers(small_buffer, tmp_path):
    config = replace(TINY, select=True)
    whole = Dlsm(config).fit(small_buffer)
    for k, until in enumerate((0.0, 0.2, 0.5, 0.9)):

        def stop(fraction, message="", *, until=until, **numbers):
            if fraction > until:
                raise Interrupted

        with pytest.raises(Interrupted):
            Dlsm(config).fit(small_buffer, stop, tmp_path)
        assert (tmp_path / "dlsm-selection.json").exists() == (k > 0)
        assert len(list(tmp_path.glob("dlsm-selection-*.pt"))) == (until < 0.3)  # the training that was cut short
    resumed = Dlsm(config).fit(small_buffer, checkpoint_dir=tmp_path)
    assert resumed.selection == whole.selection
    assert resumed.evaluate(POLICIES, 20) == whole.evaluate(POLICIES, 20)
    assert not list(tmp_path.glob("dlsm-selection-*"))


def test_a_finished_choice_is_read_and_one_of_another_buffer_refused(small_buffer, tmp_path):
    run_of(small_buffer, TINY).run(tmp_path)
    reports = []
    run_of(small_buffer, TINY).run(tmp_path, lambda *a, **k: reports.append(a))
    assert reports == []
    with pytest.raises(ValueError, match="another buffer or other DLSM settings"):
        run_of(small_buffer, TINY, fingerprint="another").run(tmp_path)


def test_a_report_that_raises_stops_a_choice_at_its_next_check(small_buffer, monkeypatch):
    steps = []
    advance = MemberTraining.advance
    monkeypatch.setattr(MemberTraining, "advance", lambda self: (steps.append(1), advance(self)))

    def stop(fraction, message="", **numbers):
        raise Interrupted

    with pytest.raises(Interrupted):
        Dlsm(replace(TINY, select=True)).fit(small_buffer, stop)
    assert len(steps) == TINY.check_every


@pytest.mark.slow
def test_members_trained_on_their_own_make_the_same_choice(small_buffer, tmp_path):
    config = replace(TINY, select=True)
    member = Dlsm(config).fit_member(small_buffer, 1, checkpoint_dir=tmp_path)
    assert member.course == Dlsm(config).fit(small_buffer).members[1].course


def test_what_a_check_found_survives_its_way_through_json(small_buffer):
    training = MemberTraining(
        small_buffer, make_batch(small_buffer, learn_scale(small_buffer)), learn_scale(small_buffer), [1], TINY, 0, ""
    )
    training.advance()
    training.check()
    assert FreeRuns.from_json(json.loads(json.dumps(training.best.to_json()))) == training.best
