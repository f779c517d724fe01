"""The size and the timetable of a simulated study."""

from __future__ import annotations

import datetime as dt
import json
from itertools import pairwise

import numpy as np
import pytest

from app.planning.protocol.schedule import SESSION_MINUTES
from app.platform.errors import Conflict, Invalid
from app.simulation.demo.study import demo_visits
from app.simulation.design import PRESETS, design, remember, visit_day
from app.study.schemas import ConditionsChange
from ml.population import PARTICIPANTS

TODAY = dt.date(2026, 6, 1)


@pytest.mark.parametrize("preset", PRESETS)
def test_every_preset_keeps_to_the_papers_session_rules(preset):
    size = PRESETS[preset]
    assert 2 <= 2 * size.policies_per_kind <= 4
    assert SESSION_MINUTES[0] <= size.session_minutes <= SESSION_MINUTES[1]


def test_the_full_preset_spends_about_the_minutes_of_the_papers_table():
    size = PRESETS["full"]
    tested = (size.visits - size.random_visits) * size.policies_per_kind * size.session_minutes
    assert 80 <= tested <= 182  # RL and distilled RL, each; Table 1 of the paper has 80 to 182
    assert 36 <= size.visits * 5 + 5 <= 52  # no-DBS; Table 1 has 36 to 52


def test_visits_are_a_month_apart_and_all_past():
    days = [visit_day(TODAY, 5, n) for n in range(1, 6)]
    assert all(later - earlier == dt.timedelta(days=28) for earlier, later in pairwise(days))
    assert days[-1] < TODAY


@pytest.mark.parametrize(
    ("codes", "visits", "preset", "message"),
    [(["P9"], 3, "quick", "P9"), (["P1", "P1"], 3, "quick", "each once"), (["P1"], 1, "quick", "1 visits"), (["P1"], 3, "slow", "slow")],
)
def test_a_study_that_cannot_be_simulated_is_refused_by_name(codes, visits, preset, message):
    with pytest.raises(Invalid, match=message):
        design(codes, visits, 0, preset)


def test_a_study_goes_on_under_its_first_date_and_another_one_is_refused_in_its_place(tmp_path):
    path = tmp_path / "state.json"
    wanted = design(["P1"], 3, 5, "quick")
    begun = remember(path, wanted, TODAY)
    longer = design(["P1", "P2"], 6, 5, "quick")
    assert remember(path, longer, TODAY + dt.timedelta(days=9)).first == begun.first == visit_day(TODAY, 3, 1)
    for other in (design(["P1"], 3, 6, "quick"), design(["P1"], 3, 5, "full")):
        with pytest.raises(Conflict, match="seed 5"):
            remember(path, other, TODAY)


def test_a_study_of_another_version_is_left_alone(tmp_path):
    path = tmp_path / "state.json"
    remember(path, design(["P1"], 3, 5, "quick"), TODAY)
    stored = json.loads(path.read_text())
    path.write_text(json.dumps({name: value for name, value in stored.items() if name != "version"}))
    with pytest.raises(Conflict, match="another version of betaloop"):
        remember(path, design(["P1"], 3, 5, "quick"), TODAY)


def test_the_demos_random_sessions_follow_one_stratified_design_that_is_stated_with_them():
    visits = demo_visits("P2", TODAY)
    random = [s for v in visits for s in v.sessions if s.controller == "random"]
    assert len(random) == 9
    fine = sorted(int((s.design.level - 0.3) / 0.7 * 9) for s in random)
    assert fine == list(range(9))  # each ninth of [B, 1] once
    assert all(s.conditions() is None for v in visits for s in v.sessions if s.controller != "random")
    stated = ConditionsChange.model_validate(random[0].conditions())
    assert stated.design == "stratified"
    ran = random[0].simulated.amplitude
    wanted = np.repeat([h.amplitude for h in stated.design_parameters.holds], [h.steps for h in stated.design_parameters.holds])
    assert np.abs(ran - wanted).max() <= 0.05 / PARTICIPANTS["P2"].cdbs_amplitude_ma + 1e-9  # rounded to 0.1 mA
    assert ran.min() >= 0.3
