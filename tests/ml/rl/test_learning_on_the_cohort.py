"""Six policies from three visits of a synthetic participant, against controllers without learning.

Coefficients are the publications'. Three of the six are of an earlier six that was measured on these data sets. In the other three cDBS
anchors the actor instead of the logged action (`anchor`), because logged actions of the random controller are draws without a preference.
They, and everything else here, were fixed before their true returns were seen, but for one rule. A state may be kept only where it stays in
the random controller's range. That rule was added after a data set of another seed had gone wrong; it changes none of these three here.

Nothing in training or selection sees a true return. The best state of each training is chosen by fitted Q evaluation on held-out sessions
among those in range (`ml.policies.logged_range`). The policy to prefer is chosen by the lower bound of its estimated gain over cDBS
(`ml.ope.compare.selection`), and none where no bound is above 0. True returns are for measuring alone, and all controllers meet the same
days and noise.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass

import numpy as np
import pytest

from ml.ope.compare.selection import surest
from ml.ope.fqe.score import fqe_value
from ml.ope.posterior.gains import gains_over_cdbs
from ml.policies.from_buffer import best_constant
from ml.policies.logged_range import stays_in_range
from ml.policies.policy import ConstantPolicy
from ml.population import random_controller_buffer, true_return
from ml.rl import ALGORITHMS, HeldOutSessions, TrainedPolicy, fit_end_reward, split_sessions, train_many

AT_CDBS = {"anchor": "constant", "anchor_amplitude": 1.0}
SIX = (
    ("ddpg", {"actor_lr": 1e-4}),
    ("rebrac", {"actor_lr": 3e-4, "actor_penalty": 0.1} | AT_CDBS),
    ("td3_bc", {"actor_lr": 3e-4, "aim": "return"}),
    ("td3_bc", {"actor_lr": 3e-4, "aim": "return"} | AT_CDBS),
    ("rebrac", {"actor_lr": 3e-4, "actor_penalty": 0.1, "aim": "return"}),
    ("rebrac", {"actor_lr": 3e-4, "actor_penalty": 0.1, "aim": "return"} | AT_CDBS),
)
SHARED = {"updates": 5000, "batch": 64, "record_every": 500}
VISITS, SESSIONS_PER_VISIT, STEPS = 3, 6, 300
CONSTANTS = (0.5, 0.6, 0.7, 0.8, 0.9)
DAYS = 40
"""Independent sessions behind each true return."""


@dataclass(frozen=True)
class Learned:
    """One of the six: its training, its estimates, its truth, and whether its critic's sum holds shares of r_end."""

    label: str
    training: TrainedPolicy
    returns: np.ndarray
    energy: float
    step_return: float
    shares: bool

    def over_estimate(self, gamma):
        """Compute Q(s_0, pi(s_0)) of the kept state, less the true value of what its critic sums, continued for ever at its own rate."""
        watched = self.training.held_out
        kept = watched["update"] == (self.training.best_update or watched["update"][-1])
        true = float(self.returns.mean()) if self.shares else self.step_return
        return float(watched["start_q"][kept][0]) - true / (1 - gamma**STEPS)


def kind(changes):
    """Return what policies trained side by side must share."""
    return changes.get("aim", "steps"), changes.get("anchor", "logged")


def six_policies(train, watch):
    """Train the six in the order of `SIX`; those of one algorithm, aim and anchor side by side."""
    trained = [None] * len(SIX)
    for name, shared in dict.fromkeys((name, kind(changes)) for name, changes in SIX):
        places = [k for k, (own, changes) in enumerate(SIX) if (own, kind(changes)) == (name, shared)]
        algorithm = ALGORITHMS[name]
        configs = [algorithm.config(**SHARED, **SIX[k][1], seed=k) for k in places]
        for k, result in zip(places, train_many(train, configs, held_out=watch), strict=True):
            trained[k] = result
    return trained


def standard_error(differences):
    return float(differences.std(ddof=1) / np.sqrt(differences.size))


@pytest.mark.slow
@pytest.mark.parametrize("participant", ["P1", "P2", "P3", "P4"])
def test_the_best_of_six_against_continuous_random_and_constant_stimulation(participant, capsys):
    buffer = random_controller_buffer(participant, VISITS, SESSIONS_PER_VISIT, STEPS, seed=2026)
    train, held = split_sessions(buffer, 0.25)

    def score(policy):
        return fqe_value(train, policy, held.sessions).value

    watch = HeldOutSessions(sessions=held, score=score, score_name="fqe", eligible=lambda policy: stays_in_range(policy, train), every=1000)
    trained = six_policies(train, watch)
    shared = fit_end_reward(train) is not None

    def truth(controller):
        result = true_return(controller, participant, buffer.settings, sessions=DAYS, seed=7, steps=STEPS)
        return result.returns, result.energy.mean, result.step_return.mean

    six = [
        Learned(f"{name} {' '.join(kind(changes))}", result, *truth(result.policy), shared and kind(changes)[0] == "return")
        for (name, changes), result in zip(SIX, trained, strict=True)
    ]
    cdbs, random = truth("cdbs")[0], truth("random")[0]
    constants = {level: truth(ConstantPolicy(level))[0] for level in CONSTANTS}
    level = max(constants, key=lambda a: constants[a].mean())
    chosen_constant = best_constant(score, CONSTANTS).policy.amplitude
    gains = gains_over_cdbs(buffer, {str(k): one.training.policy for k, one in enumerate(six)})
    name = surest({key: one.gain for key, one in gains.items() if one.told and one.supported})
    preferred = None if name is None else six[int(name)]
    best = max(six, key=lambda one: one.returns.mean())

    def saves_a_fifth(one):
        # to the whole per cent: processors round differently, and training carries that into tenths of a per cent
        return round(1 - one.energy, 2) >= 0.2

    def meets_every_aim(one):
        over = one.returns - constants[level]
        above = one.returns.mean() > max(cdbs.mean(), random.mean())
        return bool(above and over.mean() >= -standard_error(over) and saves_a_fifth(one))

    lines = [
        f"{participant}: cDBS {cdbs.mean():.1f}, random {random.mean():.1f}, best constant {level} {constants[level].mean():.1f}, "
        f"constant chosen from the data {chosen_constant} {constants[chosen_constant].mean():.1f}; "
        f"{'r_end falls apart into steps' if shared else 'no share of r_end could be learnt: all six learn from step rewards'}"
    ]
    for k, one in enumerate(six):
        over, estimated = one.returns - constants[level], gains[str(k)].gain
        lines.append(
            f"  {one.label:<22} true {one.returns.mean():6.1f}, above best constant {over.mean():5.1f} +- {standard_error(over):.1f}, "
            f"energy {one.energy:.2f}, update {one.training.best_update}, estimated above cDBS {estimated.value:5.1f} (at least "
            f"{estimated.low:.1f}), Q above truth {one.over_estimate(buffer.settings.gamma):5.1f}"
            f"{' best by truth' * (one is best)}{' preferred from the data' * (one is preferred)}{' all aims' * meets_every_aim(one)}"
        )
    over_cdbs, over_constant = best.returns - cdbs, best.returns - constants[level]
    aims = {
        "best above cDBS": over_cdbs.mean() > 0,
        "best above random": best.returns.mean() > random.mean(),
        "best level with the best constant": over_constant.mean() >= -standard_error(over_constant),
        "best saves a fifth of the energy": saves_a_fifth(best),
        "one of the six meets all of these": any(meets_every_aim(one) for one in six),
    }
    if preferred is not None:
        aims["preferred from the data is not below cDBS"] = bool(preferred.returns.mean() >= cdbs.mean())
    lines.append("  aims: " + ", ".join(f"{name} {'met' if met else 'MISSED'}" for name, met in aims.items()))
    if preferred is None:
        lines.append("  from the data alone no policy is preferred to cDBS")
    with capsys.disabled():
        sys.stdout.write("\n" + "\n".join(lines) + "\n")
    assert aims["best above cDBS"]
    assert aims["best above random"]
    assert aims["best level with the best constant"]
    assert aims["one of the six meets all of these"]
    if preferred is None:
        # then no bound may speak for any of them: an estimate above cDBS that was passed over is as wrong as a bad preference
        assert all(one.gain.low <= 0 or not (one.told and one.supported) for one in gains.values())
    else:
        assert aims["preferred from the data is not below cDBS"]
