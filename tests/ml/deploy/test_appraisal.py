"""Appraisal of a bundle before it is used: amplitudes, energy and battery."""

from __future__ import annotations

import dataclasses
import io
import zipfile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from ml.deploy.appraisal import MANY, BundleWarning, WarningCode, battery_gain, of, warnings
from ml.deploy.bundle import build_bundle, verify_bundle
from ml.deploy.wording import battery_words, warning_sentences
from ml.energy import Range
from ml.rl import MlpPolicy


@pytest.fixture
def logged(manifest):
    """B = 0.3 of 3 mA is 0.9 mA; the clinician's lowest is 0.5 mA."""
    return dataclasses.replace(manifest, test_windows_from="snapshot 4", logged_lower_bound=0.3)


def test_shares_and_energy_are_those_of_the_fractions(logged):
    facts = of(np.array([0.1, 0.2, 0.5, 1.0]), logged)
    given_ma = np.array([0.5, 0.6, 1.5, 3.0])
    assert facts["asked_mean"] == pytest.approx(0.45)
    assert facts["asked_below_bound"] == 0.5
    assert facts["asked_below_minimum"] == 0.25, "0.3 mA alone"
    assert facts["energy_of_cdbs"] == pytest.approx(np.mean((given_ma / 3.0) ** 2))
    assert facts["charge_of_cdbs"] == pytest.approx(np.mean(given_ma / 3.0))


def test_on_windows_that_nobody_logged_nothing_is_said_but_that(manifest):
    assert of(np.array([0.0, 0.1]), manifest) == {"test_windows": 2}
    assert warnings(manifest) == [BundleWarning(WarningCode.UNTRIED)]
    (only,) = warning_sentences(manifest)
    assert "Nobody knows" in only


@pytest.mark.hazard("H04")
def test_a_policy_that_often_leaves_what_was_tried_or_allowed_is_warned_of_on_the_sheet(logged, test_windows):
    def sheet(bias):
        policy = MlpPolicy(10, (4,), mean=120.0, std=35.0, seed=1)
        policy.layers[-1].bias.data.fill_(bias)  # (tanh(bias) + 1) / 2
        content = build_bundle(policy.to_onnx(), logged, test_windows)
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            return warnings(verify_bundle(content)), archive.read("sheet.html").decode()

    low, text = sheet(-1.2)  # 0.08: 0.25 mA
    assert [(w.code, w.value, w.limit) for w in low] == [
        (WarningCode.BELOW_LOGGED, 1.0, pytest.approx(0.9)),
        (WarningCode.BELOW_MINIMUM, 1.0, 0.5),
    ]
    for sentence in ("B = 0.3 of cDBS, 0.9 mA) in 100 % of 16 recorded windows", "lowest amplitude (0.5 mA) in 100 %"):
        assert sentence in text
    between, text = sheet(-0.6)  # 0.23: 0.69 mA
    assert len(between) == 1
    assert "below 0.5 mA (lowest) in 0 %, below 0.9 mA (B, lowest tried at random) in 100 %" in text
    none, text = sheet(0.5)
    assert none == []
    assert "battery life" in text
    assert "assumed: no recording holds it" in text


def test_few_windows_are_no_warning(logged):
    fractions = np.full(100, 0.6)
    fractions[: int(100 * MANY) - 1] = 0.0
    assert warnings(dataclasses.replace(logged, **of(fractions, logged))) == []
    fractions[:10] = 0.0
    assert len(warnings(dataclasses.replace(logged, **of(fractions, logged)))) == 2


def test_battery_life_by_hand():
    """Half the amplitude: a quarter of the energy, half of the charge."""
    assert battery_gain(0.25, 0.5, Range(0.5, 0.5)) == Range(1 / (1 - 0.5 * 0.5), 1 / (1 - 0.5 * 0.75))
    assert battery_gain(0.25, 0.5, Range(0.0, 0.0)) == Range(1.0, 1.0), "what does not draw saves nothing"
    assert battery_gain(1.0, 1.0) == Range(1.0, 1.0)
    assert battery_gain(1.21, 1.1).high < 1.0, "more than cDBS shortens it"
    assert "75 % less stimulation energy" in battery_words(0.25, 0.5)
    assert "21 % more stimulation energy" in battery_words(1.21, 1.1)
    with pytest.raises(ValueError, match="shares"):
        battery_gain(0.5, 0.5, Range(0.5, 1.0))


@given(st.lists(st.floats(0, 1), min_size=1), st.floats(0, 0.95))
def test_no_battery_gains_more_than_its_stimulation_draws(fractions, share):
    a = np.array(fractions)
    gain = battery_gain(float(np.mean(a**2)), float(a.mean()), Range(share, share))
    assert 1 - 1e-12 <= gain.low <= gain.high <= 1 / (1 - share) + 1e-9
