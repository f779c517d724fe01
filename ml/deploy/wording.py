"""Sentences about a bundle, made of typed values at the last moment; nothing reads them back."""

from __future__ import annotations

from ml.deploy.appraisal import STIMULATION_SHARE, BundleWarning, WarningCode, battery_gain, warnings
from ml.deploy.manifest import BundleManifest
from ml.energy import saving_percent


def warning_sentences(manifest: BundleManifest) -> list[str]:
    """Write the bundle's warnings for the clinician as sentences; empty where there are none."""
    return [_sentence(warning, manifest) for warning in warnings(manifest)]


def _sentence(warning: BundleWarning, m: BundleManifest) -> str:
    if warning.code == WarningCode.UNTRIED or warning.value is None or warning.limit is None:
        return "Nobody knows what this policy asks for on this participant's beta: no recorded beta of its window was there to try it on."
    share = f"{100 * warning.value:.0f} % of {m.test_windows} recorded windows"
    if warning.code == WarningCode.BELOW_LOGGED:
        bound = f"B = {warning.limit / m.cdbs_ma:g} of cDBS, {warning.limit:.4g} mA"
        return f"Asks for less than was tried at random ({bound}) in {share}: no data there."
    return f"Asks for less than the lowest amplitude ({warning.limit:g} mA) in {share}: there the limit decides."


def energy_words(energy_of_cdbs: float) -> str:
    """Describe stimulation energy against cDBS."""
    saved = saving_percent(energy_of_cdbs, 1.0)
    if abs(saved) < 0.5:
        return "as much stimulation energy as cDBS"
    return f"{abs(saved):.0f} % {'less' if saved >= 0 else 'more'} stimulation energy than cDBS"


def battery_life_words(energy_of_cdbs: float, charge_of_cdbs: float) -> str:
    """Describe battery life against cDBS, with the assumption that it rests on."""
    gain = battery_gain(energy_of_cdbs, charge_of_cdbs)
    share = f"{100 * STIMULATION_SHARE.low:.0f} to {100 * STIMULATION_SHARE.high:.0f} %"
    return (
        f"battery life {gain.low:.2f} to {gain.high:.2f} times that of cDBS, if stimulation draws {share} of the implant's power "
        "(assumed: no recording holds it)"
    )


def battery_words(energy_of_cdbs: float, charge_of_cdbs: float) -> str:
    """Describe energy and battery life in one sentence."""
    return f"{energy_words(energy_of_cdbs)}; {battery_life_words(energy_of_cdbs, charge_of_cdbs)}"
