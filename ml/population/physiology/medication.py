"""Levodopa from tablet to effect: absorption, two compartments, an effect site and a long-duration floor.

Population values per 70 kg after Chan, Nutt and Holford 2005 (J Pharmacokinet Pharmacodyn, s10928-005-0039-x); the rest is assumed.
"""

from __future__ import annotations

import math
from functools import cache
from typing import Final

import numpy as np
import scipy
from numpy.typing import NDArray

from ml.population.participants import Regimen

DOSE_MG: Final = 100.0  # levodopa in one Sinemet 25/100 tablet (Gao et al. 2023, appendix)
CENTRAL_L, CLEARANCE_L_H, PERIPHERAL_L, EXCHANGE_L_H = 11.4, 30.9, 27.3, 34.6  # Chan 2005
ABSORPTION_PER_H, BIOAVAILABILITY = 2.5, 0.84  # assumed
EFFECT_HALF_LIFE_H, EC50_MG_L, HILL = 0.4, 0.7, 3.5  # assumed
LONG_DURATION_FLOOR: Final = 0.25  # assumed size; that a long-duration response exists: Chan 2004
GRID_PER_H: Final = 120
GRID_HOURS: Final = 24


@cache
def effect_site_curve() -> NDArray[np.float64]:
    """Compute the effect-site concentration (mg/L) after one tablet, every 30 s for 24 h, by the exact propagator of the linear system."""
    k_e0 = math.log(2) / EFFECT_HALF_LIFE_H
    rates = np.array(
        [  # amounts in gut, central and peripheral compartment (mg), concentration at the effect site (mg/L)
            [-ABSORPTION_PER_H, 0.0, 0.0, 0.0],
            [ABSORPTION_PER_H, -(CLEARANCE_L_H + EXCHANGE_L_H) / CENTRAL_L, EXCHANGE_L_H / PERIPHERAL_L, 0.0],
            [0.0, EXCHANGE_L_H / CENTRAL_L, -EXCHANGE_L_H / PERIPHERAL_L, 0.0],
            [0.0, k_e0 / CENTRAL_L, 0.0, -k_e0],
        ]
    )
    propagator = scipy.linalg.expm(rates / GRID_PER_H)
    amounts = np.array([DOSE_MG * BIOAVAILABILITY, 0.0, 0.0, 0.0])
    curve = np.empty(GRID_HOURS * GRID_PER_H + 1)
    for n in range(curve.size):
        curve[n] = amounts[3]
        amounts = propagator @ amounts
    return curve


def effect(regimen: Regimen, hours: NDArray[np.float64], dose_factor: float = 1.0, delay_h: float = 0.0) -> NDArray[np.float64]:
    """Compute the medication effect 0-1 at `hours` of the visit day, any shape.

    Args:
        regimen: doses of the day.
        hours: time since the first session of the day, in hours; doses before it have negative times.
        dose_factor: today's exposure relative to the population (between-trial variability).
        delay_h: today's delay of absorption, such as by a meal.
    """
    if not regimen.levodopa_h:
        return np.full(hours.shape, regimen.constant)
    grid = np.arange(GRID_HOURS * GRID_PER_H + 1) / GRID_PER_H
    curve = effect_site_curve()
    concentration = np.zeros(hours.shape)
    for dose in regimen.levodopa_h:
        concentration += np.interp(hours - dose - delay_h, grid, curve, left=0.0, right=0.0)
    response = (dose_factor * concentration) ** HILL
    return LONG_DURATION_FLOOR + (1 - LONG_DURATION_FLOOR) * response / (EC50_MG_L**HILL + response)
