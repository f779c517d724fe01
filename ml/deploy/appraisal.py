"""What a policy would ask for on beta that was logged, held against what was tried before; and what that may mean for a battery.

Two warnings belong on the sheet of a bundle: a policy that often asks for amplitudes below those that were ever tried at random (B: its
estimates rest on no data there), and one that often asks for less than the clinician allows (the limits decide then, not the network).

Battery: of all that an implant draws, stimulation is a share that differs between implants and participants and that no recording holds.
With that share as an assumption, the life against cDBS is 1 / (1 - share * (1 - r)), where r lies between the mean of the squared amplitude
(an output stage without loss) and the mean amplitude (a fixed supply voltage). Source of the energy model: `ml/energy.py`.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.deploy.manifest import BundleManifest
from ml.energy import Range, saving_percent

MANY = 0.05
"""Share of windows from which a sheet warns."""
STIMULATION_SHARE = Range(0.3, 0.9)
"""Assumed share of stimulation in all that an implant draws under cDBS: no measurement, and no default of any implant."""


def of(fractions: NDArray[np.float64], manifest: BundleManifest) -> dict[str, Any]:
    """What the network asks for, as entries of the manifest; only their number where the windows were not logged.

    Args:
        fractions: its answers to the test windows, [M].
        manifest: with limits, B, and where the windows come from.
    """
    facts: dict[str, Any] = {"test_windows": len(fractions)}
    if manifest.test_windows_from is None:
        return facts
    asked_ma = fractions * manifest.cdbs_ma
    given = np.clip(asked_ma, manifest.min_ma, manifest.max_ma) / manifest.cdbs_ma
    bound = manifest.logged_lower_bound
    return facts | {
        "asked_mean": float(fractions.mean()),
        "asked_below_bound": None if bound is None else float(np.mean(fractions < bound - 1e-6)),
        "asked_below_minimum": float(np.mean(asked_ma < manifest.min_ma - 1e-6)),
        "energy_of_cdbs": float(np.mean(given**2)),
        "charge_of_cdbs": float(given.mean()),
    }


def warnings(manifest: BundleManifest) -> list[str]:
    """What the clinician must know of the policy before it is used; empty where nothing stands out."""
    m, out = manifest, []
    if m.test_windows_from is None:
        return ["Nobody knows what this policy asks for on this participant's beta: no logged beta of its window was there to try it on."]
    if m.asked_below_bound is not None and m.logged_lower_bound is not None and m.asked_below_bound >= MANY:
        out.append(
            f"Asks for less than was tried at random (B = {m.logged_lower_bound:g} of cDBS, {m.logged_lower_bound * m.cdbs_ma:.3g} mA) "
            f"in {100 * m.asked_below_bound:.0f} % of {m.test_windows} logged windows: no data there."
        )
    if m.asked_below_minimum is not None and m.asked_below_minimum >= MANY:
        out.append(
            f"Asks for less than the lowest amplitude ({m.min_ma:g} mA) in {100 * m.asked_below_minimum:.0f} % of {m.test_windows} "
            "logged windows: there the limit decides."
        )
    return out


def battery_gain(energy_of_cdbs: float, charge_of_cdbs: float, share: Range = STIMULATION_SHARE) -> Range:
    """Battery life as a multiple of that under cDBS: the range over both models of the output stage and all shares.

    Args:
        energy_of_cdbs, charge_of_cdbs: mean square and mean of the amplitude over cDBS, 0 or more.
        share: of stimulation in all that the implant draws under cDBS, between 0 and 1.

    Raises:
        ValueError: a share outside [0, 1), or below 0 what cannot be.
    """
    if not (share.low >= 0 and share.high < 1 and energy_of_cdbs >= 0 and charge_of_cdbs >= 0):
        raise ValueError(f"shares lie in [0, 1) and amplitudes are 0 or more, not {share}, {energy_of_cdbs} and {charge_of_cdbs}")
    gains = [1.0 / (1.0 - part * (1.0 - r)) for part in (share.low, share.high) for r in (energy_of_cdbs, charge_of_cdbs)]
    return Range(min(gains), max(gains))


def battery_words(energy_of_cdbs: float, charge_of_cdbs: float) -> str:
    """Saving and battery life in one sentence that carries its assumption."""
    gain = battery_gain(energy_of_cdbs, charge_of_cdbs)
    share = f"{100 * STIMULATION_SHARE.low:.0f} to {100 * STIMULATION_SHARE.high:.0f} %"
    saved = saving_percent(energy_of_cdbs, 1.0)
    energy = f"{abs(saved):.0f} % {'less' if saved >= 0 else 'more'} stimulation energy than cDBS"
    if abs(saved) < 0.5:
        energy = "as much stimulation energy as cDBS"
    return (
        f"{energy}; battery life {gain.low:.2f} to {gain.high:.2f} times that of cDBS, if stimulation draws {share} of the implant's power "
        "(assumed: no recording holds it)"
    )
