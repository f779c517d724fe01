"""Off-policy evaluation: the return of a policy that has not run, estimated from logged sessions. Source: Gao et al. 2023, section 5.

This module names what the service uses. A name is imported at its first use, so that a page which shows estimates loads no network.

* An `Estimate` has a policy's return with its interval (`LEVEL`), predicted outcomes, and a `Flag` for each reason to doubt it.
* `methods` lists every method; `build` and `estimators` make an `Estimator`, which is fitted to a buffer and evaluates policies.
* `rank_policies`, `gain_over` and `accuracy` compare estimates. `held_out_skill` compares methods with controllers that they did not see.
* `diagnose` and `behaviour_map` say what the sessions support, whatever the methods estimate.
* `verdict` decides whether a policy is worth a test, and `portfolio` chooses the policies of a visit; both read the posterior.

`ml.ope.posterior.further_sessions` is public too: the sessions that would settle an open verdict.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from ml.ope.adaptation import Adaptation, Gain, adaptation_of, gain_by_following
    from ml.ope.compare.aggregate import combine
    from ml.ope.compare.gain import gain_over
    from ml.ope.compare.metrics import Accuracy, accuracy
    from ml.ope.compare.ranking import default_method, rank_policies
    from ml.ope.compare.selection import surest
    from ml.ope.compare.skill import held_out_skill, with_held_out_error
    from ml.ope.estimate import LEVEL, Estimate, Estimator
    from ml.ope.flags import Flag, distinct, not_counted_tests
    from ml.ope.posterior.estimator import FittedPosterior, Posterior
    from ml.ope.posterior.gains import PosteriorGain, Tests, gains_over_cdbs
    from ml.ope.posterior.gaussian import QUANTITIES, TestedDifference
    from ml.ope.posterior.portfolio import Suggestion, portfolio
    from ml.ope.posterior.support import FEWEST_VISITS
    from ml.ope.posterior.tested import TestSession, differences_to_cdbs, spread_of_random
    from ml.ope.posterior.verdict import (
        FEWEST_DRAWS,
        HAZARDS,
        NEARLY_OFF,
        RELIABILITY,
        SAME_AMPLITUDE,
        SETTLED_BY_SESSIONS,
        Levels,
        Verdict,
        chance_within,
        interval,
        outcome_draws,
        verdict,
    )
    from ml.ope.registry import AGGREGATE, POSTERIOR, Method, Size, build, estimators, method_keys, methods, quick_estimators, shown
    from ml.ope.support.behaviour_map import DOSES, BehaviourMap, behaviour_map
    from ml.ope.support.diagnostics import diagnose

_HOMES = {
    "estimate": ("LEVEL", "Estimate", "Estimator"),
    "flags": ("Flag", "distinct", "not_counted_tests"),
    "adaptation": ("Adaptation", "Gain", "adaptation_of", "gain_by_following"),
    "registry": ("AGGREGATE", "POSTERIOR", "Method", "Size", "build", "estimators", "method_keys", "methods", "quick_estimators", "shown"),
    "compare.metrics": ("Accuracy", "accuracy"),
    "compare.gain": ("gain_over",),
    "compare.ranking": ("default_method", "rank_policies"),
    "compare.selection": ("surest",),
    "compare.aggregate": ("combine",),
    "compare.skill": ("held_out_skill", "with_held_out_error"),
    "support.behaviour_map": ("DOSES", "BehaviourMap", "behaviour_map"),
    "support.diagnostics": ("diagnose",),
    "posterior.estimator": ("FittedPosterior", "Posterior"),
    "posterior.gains": ("PosteriorGain", "Tests", "gains_over_cdbs"),
    "posterior.gaussian": ("QUANTITIES", "TestedDifference"),
    "posterior.portfolio": ("Suggestion", "portfolio"),
    "posterior.support": ("FEWEST_VISITS",),
    "posterior.tested": ("TestSession", "differences_to_cdbs", "spread_of_random"),
    "posterior.verdict": (
        *("FEWEST_DRAWS", "HAZARDS", "NEARLY_OFF", "RELIABILITY", "SAME_AMPLITUDE", "SETTLED_BY_SESSIONS", "Levels", "Verdict"),
        *("chance_within", "interval", "outcome_draws", "verdict"),
    ),
}
_HOME_OF = {name: home for home, names in _HOMES.items() for name in names}

# fmt: off
__all__ = [
    "AGGREGATE", "DOSES", "FEWEST_DRAWS", "FEWEST_VISITS", "HAZARDS", "LEVEL", "NEARLY_OFF", "POSTERIOR", "QUANTITIES", "RELIABILITY",
    "SAME_AMPLITUDE", "SETTLED_BY_SESSIONS", "Accuracy", "Adaptation", "BehaviourMap", "Estimate", "Estimator", "FittedPosterior", "Flag",
    "Gain", "Levels", "Method", "Posterior", "PosteriorGain", "Size", "Suggestion", "TestSession", "TestedDifference", "Tests", "Verdict",
    "accuracy", "adaptation_of", "behaviour_map", "build", "chance_within", "combine", "default_method", "diagnose",
    "differences_to_cdbs", "distinct", "estimators", "gain_by_following", "gain_over", "gains_over_cdbs", "held_out_skill", "interval",
    "method_keys", "methods", "not_counted_tests", "outcome_draws", "portfolio", "quick_estimators", "rank_policies", "shown",
    "spread_of_random", "surest", "verdict", "with_held_out_error",
]
# fmt: on


def __getattr__(name: str) -> Any:
    """Import a public name from its module. Raises AttributeError for any other name."""
    if name not in _HOME_OF:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    return getattr(import_module(f"{__name__}.{_HOME_OF[name]}"), name)
