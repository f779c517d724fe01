"""Appraisal of a policy: the amplitudes that it requests on logged beta, compared with those tried before, and what they may mean for a
battery.

The sheet of a bundle has two warnings. One is about a policy that often requests amplitudes below those ever tried at random: its estimates
rest on no data below B. The other is about a policy that often requests less than the clinician allows: the limits decide then, not the
network.

Battery: stimulation takes a share of all that an implant draws. The share differs between implants and participants, and no recording
contains it. With that share as an assumption, the life against cDBS is 1 / (1 - share * (1 - r)). Here r is between the mean of the squared
amplitude (an output stage without loss) and the mean amplitude (a fixed supply voltage). Source of the energy model: `ml/energy.py`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.deploy.manifest import BundleManifest
from ml.energy import Range
from ml.trajectories import SessionTrajectory

MANY = 0.05
"""Share of windows from which a sheet warns."""
STIMULATION_SHARE = Range(0.3, 0.9)
"""Assumed share of stimulation in all that an implant draws under cDBS: no measurement, and no default of any implant."""


def of(fractions: NDArray[np.float64], manifest: BundleManifest) -> dict[str, Any]:
    """Summarise what the network requests, as entries of the manifest; only the number of windows where they were not logged.

    Args:
        fractions: its answers to the test windows, [M].
        manifest: with limits, B, and where the windows come from.
    """
    facts: dict[str, Any] = {"test_windows": len(fractions)}
    if manifest.test_windows_from is None:
        return facts
    asked_ma = fractions * manifest.cdbs_ma
    given = np.clip(asked_ma, manifest.min_ma, manifest.max_ma) / manifest.cdbs_ma
    bound = manifest.logged_bound_ma
    return facts | {
        "asked_mean": float(fractions.mean()),
        "asked_below_bound": None if bound is None else float(np.mean(fractions < bound / manifest.cdbs_ma - 1e-6)),
        "asked_below_minimum": float(np.mean(asked_ma < manifest.min_ma - 1e-6)),
        "energy_of_cdbs": float(np.mean(given**2)),
        "charge_of_cdbs": float(given.mean()),
    }


FROZEN_AFTER = 5
"""So many equal beta amplitudes in a row are none: a measured one never comes twice to the last digit of a float32."""
SATURATED_AT = 3.0
"""Times the highest beta amplitude that was logged."""
LEVEL_SPREAD = 2.5
"""Factor by which a window's mean may be outside the range of the logged ones; a unit that is wrong by ten is farther outside."""


def plausible_beta(windows: NDArray[np.float64] | None) -> dict[str, Any]:
    """Derive limits of beta for the safety envelope, as entries of the manifest.

    Args:
        windows: logged, [N, W]; None where nothing was, so that no level is known.
    """
    if windows is None or not windows.size or float(windows.min()) < 0:
        return {"frozen_after": FROZEN_AFTER}
    means = windows.mean(axis=1)
    return {
        "frozen_after": FROZEN_AFTER,
        "beta_max": SATURATED_AT * float(windows.max()),
        "level_low": float(means.min()) / LEVEL_SPREAD,
        "level_high": float(means.max()) * LEVEL_SPREAD,
    }


def imputation(sessions: Sequence[SessionTrajectory], window: int) -> dict[str, Any]:
    """Derive the imputation of lost beta as learning has it, as entries of the manifest; none where nothing was logged.

    Args:
        sessions: of the snapshot. window: W of the policy.
    """
    most = min(max((s.most_imputed for s in sessions), default=0), window - 1)
    return {"most_imputed": most, "carried_over": float(np.mean([s.carried_over for s in sessions]))} if most else {}


class WarningCode(StrEnum):
    """Facts that a clinician must know of a policy before it is used."""

    UNTRIED = "untried"
    BELOW_LOGGED = "below_logged"
    BELOW_MINIMUM = "below_minimum"


@dataclass(frozen=True)
class BundleWarning:
    """One warning.

    Attributes:
        value: share of the logged test windows for which the policy asks for less than `limit`; None where it could not be tried.
        limit: amplitude, mA; None where it could not be tried.
    """

    code: WarningCode
    value: float | None = None
    limit: float | None = None


def warnings(manifest: BundleManifest) -> list[BundleWarning]:
    """List the warnings about a policy's answers; `wording` makes sentences of them."""
    m, out = manifest, []
    if m.schedule is not None:
        return []
    if m.test_windows_from is None:
        return [BundleWarning(WarningCode.UNTRIED)]
    if m.asked_below_bound is not None and m.logged_bound_ma is not None and m.asked_below_bound >= MANY:
        out.append(BundleWarning(WarningCode.BELOW_LOGGED, m.asked_below_bound, m.logged_bound_ma))
    if m.asked_below_minimum is not None and m.asked_below_minimum >= MANY:
        out.append(BundleWarning(WarningCode.BELOW_MINIMUM, m.asked_below_minimum, m.min_ma))
    return out


def battery_gain(energy_of_cdbs: float, charge_of_cdbs: float, share: Range = STIMULATION_SHARE) -> Range:
    """Compute battery life as a multiple of that under cDBS: the range over both models of the output stage and all shares.

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
