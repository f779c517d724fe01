"""The estimator `posterior`: what every policy would return, and how sure that is, from all structures and all tested sessions.

Structures (`structures`) replay the logged sessions under every policy with draws of their coefficients and are averaged by how well they
predict left-out sessions (`held_out`). What they get wrong is added as far as sessions lie from the policy (`support`, `constants`), alike
for policies that act alike (`gaussian`). Sessions that tested a policy then move the draws of all that resemble it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.ope.estimate import LEVEL, Estimate, checked_horizon
from ml.ope.flags import FEW_END_REWARDS, Flag, distinct, stopped_sessions
from ml.ope.lead import dose_before
from ml.ope.linear.estimator import FittedLinear, LinearConfig, Replayed
from ml.ope.outcomes.model import EndModel, fit_end_model
from ml.ope.outcomes.pooling import Evidence, Pooled, gain, pool
from ml.ope.posterior.constants import COMMON_SHARE, MODEL_ERRORS, VERSION, ModelError
from ml.ope.posterior.draws import STATISTICAL, Draws, Replays, joint_draws
from ml.ope.posterior.further_sessions import return_noise
from ml.ope.posterior.gaussian import QUANTITIES, TestedDifference, similarity, updated
from ml.ope.posterior.held_out import HeldOut, held_out
from ml.ope.posterior.skill import ordering_skill
from ml.ope.posterior.structures import STRUCTURES, Fit, no_answer
from ml.ope.posterior.support import SessionSupport, Support
from ml.ope.registry import Size
from ml.ope.scale import Scale, learn_scale
from ml.ope.support.coverage import AmplitudeSupport
from ml.outcomes import PREDICTED
from ml.policies.policy import ConstantPolicy, Policy
from ml.progress import Report, silent
from ml.trajectories import ReplayBuffer

Floats = NDArray[np.float64]

CDBS = "cDBS, for comparison"
"""Name of the constant policy at 1 that is always evaluated too: tests are differences to it."""

LEAST_DRAWS = 6
"""Draws of a structure that has a say at all."""
LEAST_WEIGHT = 0.02
"""Structures below this weight have none."""

LIMITS = {"energy": (0.0, 1.0)} | {o.field: o.limits for o, _ in PREDICTED}


@dataclass(frozen=True, kw_only=True)
class PosteriorConfig:
    """Settings of the posterior.

    Attributes:
        draws: sets of coefficients, over all structures together, with which every session is replayed.
        most_rows: replayed sessions per policy at most; a longer record takes fewer draws, though never fewer than 24.
        seed: of all draws.
        model_errors: what structures get wrong, by component; a component that is absent has none.
        common_share: see `constants.COMMON_SHARE`.
    """

    draws: int = 48
    most_rows: int = 1500
    seed: int = 0
    model_errors: Mapping[str, ModelError] = field(default_factory=lambda: MODEL_ERRORS)
    common_share: float = COMMON_SHARE


@dataclass(frozen=True)
class Posterior:
    """The estimator.

    Attributes:
        tests: tested sessions as differences to the same visit's cDBS; their policies must be among those that are evaluated.
        not_counted: a flag where some of the tested sessions are not among the tests, for every estimate.
        others: what the data of other participants say of the outcomes' dose shapes; None: they are not asked.
    """

    config: PosteriorConfig = field(default_factory=PosteriorConfig)
    method: str = "posterior"
    tests: tuple[TestedDifference, ...] = ()
    not_counted: Flag | None = None
    others: tuple[Evidence, ...] | None = None

    def with_tests(self, tests: Sequence[TestedDifference], not_counted: Flag | None = None) -> Posterior:
        """Return the same estimator that knows tested sessions as well; `evaluate` raises ValueError where a tested policy is not
        evaluated."""
        return replace(self, tests=tuple(tests), not_counted=not_counted)

    def with_others(self, others: Sequence[Evidence]) -> Posterior:
        """Return the same estimator with the dose shapes of outcomes pooled with other participants' where the proof holds."""
        return replace(self, others=tuple(others))

    def fit(self, buffer: ReplayBuffer, report: Report = silent, checkpoint_dir: Path | None = None) -> FittedPosterior:
        """Fit and weigh the structures; takes seconds, so nothing is kept in `checkpoint_dir`.

        Raises:
            ValueError: fewer than two sessions with usable steps.
        """
        c, scale, before = self.config, learn_scale(buffer), dose_before(buffer)
        draws = max(24, min(c.draws, c.most_rows // len(buffer.sessions)))
        fits = []
        for k, fitter in enumerate(STRUCTURES.values()):
            fits.append(fitter(buffer, scale, draws, c.seed, before))
            report(0.4 * (k + 1) / len(STRUCTURES), "fitting the structures")
        predictions = held_out(buffer, scale, fits, c.seed)
        linear = next(f for f in fits if f.key == "linear")
        equal = held_out(buffer, scale, [no_answer(linear, buffer)], c.seed).predicted["equal"]
        report(0.9, "predicting left-out sessions")
        shares = shared_out(predictions.weights, draws)
        severity = sum(predictions.weights[f.key] * f.drawn.levels.mean(0) for f in fits)
        total = sum(shares.values())
        ends = fit_end_model(buffer, draws=total, seed=c.seed, severity=np.asarray(severity), wider=1.0)
        report(1.0, "fitting the outcomes")
        fitted = FittedPosterior(self.method, c, buffer, scale, tuple(fits), shares, predictions, equal, ends, self.tests, self.not_counted)
        return fitted if self.others is None else fitted.with_pooled(pool(ends.shape_evidence, self.others))


def shared_out(weights: Mapping[str, float], draws: int) -> dict[str, int]:
    """Share draws out over the structures: none below `LEAST_WEIGHT`, and at least `LEAST_DRAWS` above it."""
    return {key: max(LEAST_DRAWS, round(w * draws)) for key, w in weights.items() if w >= LEAST_WEIGHT}


@dataclass(frozen=True)
class FittedPosterior:
    """Fitted structures with their weights, what is predicted of left-out sessions without any answer (`equal`), the tests, and what other
    participants say of dose shapes."""

    method: str
    config: PosteriorConfig
    buffer: ReplayBuffer
    scale: Scale
    fits: tuple[Fit, ...]
    shares: dict[str, int]
    predictions: HeldOut
    equal: Floats
    ends: EndModel
    tests: tuple[TestedDifference, ...]
    not_counted: Flag | None = None
    pooled: Pooled | None = None

    def with_pooled(self, pooled: Pooled) -> FittedPosterior:
        """Return the same structures with outcomes whose dose shapes have the priors of other participants."""
        ends = self._outcomes(self.buffer, pooled) if pooled.priors else self.ends
        return replace(self, ends=ends, pooled=pooled)

    def _outcomes(self, buffer: ReplayBuffer, pooled: Pooled | None) -> EndModel:
        priors, draws = pooled.priors if pooled else None, self.ends.draws
        return fit_end_model(buffer, draws=draws, seed=self.config.seed, severity=self.levels, wider=1.0, shape_priors=priors)

    def evaluate(self, policies: Mapping[str, Policy], horizon_steps: int | None = None, report: Report = silent) -> dict[str, Estimate]:
        """Compute the posterior of every policy.

        Raises:
            ValueError: a horizon below one step, or a tested policy that is not among them.
        """
        horizon = checked_horizon(self.buffer, horizon_steps)
        if not policies:
            return {}
        everyone = {**policies, CDBS: ConstantPolicy(1.0)}
        names, chosen = list(everyone), list(everyone.values())
        replays, supports, draws = self.joint(everyone, horizon, report)
        skill = ordering_skill(self.buffer, self.predictions, self.equal, self.ends, self.levels)
        common: dict[str, Any] = {"skill": skill.to_json(), "return_noise": round(return_noise(self.buffer, horizon), 4)}
        common["left_out_outcomes"] = self.ends.predictability()
        common |= {"shape_pooling": self.shape_pooling} if self.pooled is not None else {}
        look, found = AmplitudeSupport(self.buffer), {}
        moved = self._moved_as_measured(chosen, replays, horizon)
        for i, name in enumerate(names[:-1]):
            flags = [*look.of_policy(chosen[i]).flags(), *((self.not_counted,) if self.not_counted else ())]
            if moved is not None:
                counted = float(draws.values["r_end"][i].mean())
                flags.append(stopped_sessions(sum(s.stopped for s in self.buffer.sessions), counted, counted + float(moved[i])))
            found[name] = self._estimate(i, replays, draws, supports[i], common, flags, horizon)
        return found

    @property
    def shape_pooling(self) -> dict[str, Any]:
        """By outcome the proof of pooling its dose shapes (`Proof.to_json`). Where they are pooled, `own_gain` says how much better the
        others' prior predicts these very data than the flat one, nats. Empty where other participants were not asked."""
        if self.pooled is None:
            return {}
        own, priors = self.ends.shape_evidence, self.pooled.priors
        gains = {o: {"own_gain": gain(own[o], priors[o])} for o in own if o in priors}
        return {o: proof.to_json() | gains.get(o, {}) for o, proof in self.pooled.proofs.items()}

    def joint(self, policies: Mapping[str, Policy], horizon: int, report: Report = silent) -> tuple[Replays, list[Support], Draws]:
        """Compute replays, support and joint draws of all policies, cDBS last, from which their estimates are made."""
        replays = self._replays(list(policies.values()), horizon, report)
        support = SessionSupport(self.buffer)
        supports = [support.of(s) for s in replays.summaries]
        return replays, supports, self._draws(replays, policies, supports, horizon)

    def _moved_as_measured(self, policies: list[Policy], replays: Replays, horizon: int) -> Floats | None:
        """Compute what r_end of each policy, [P], would gain if stopped sessions counted as measured; None where none was, or no r_end
        is."""
        if not self.ends.seen[0] or not any(s.stopped for s in self.buffer.sessions):
            return None
        buffer = replace(self.buffer, sessions=tuple(replace(s, stopped_as=None) for s in self.buffer.sessions))
        ends = self._outcomes(buffer, self.pooled)
        other = replace(self, buffer=buffer, ends=ends)._replays(policies, horizon, silent)
        measured, counted = (np.einsum("pdn,d->p", r.outcomes[..., 0], r.weights) / len(buffer.sessions) for r in (other, replays))
        return np.asarray(measured - counted, dtype=np.float64)

    @property
    def levels(self) -> Floats:
        """Level of every session, [n], over structures."""
        return np.sum([self.predictions.weights[f.key] * f.drawn.levels.mean(0) for f in self.fits], axis=0)

    @property
    def _parts(self) -> dict[str, float]:
        """Weight of one unit of each QoC in the return."""
        parts = {o.field: o.end.per_unit(self.buffer.settings) for o, _ in PREDICTED if o.end is not None}
        return {name: weight for name, weight in parts.items() if weight}

    def _replays(self, policies: list[Policy], horizon: int, report: Report) -> Replays:
        """Combine every structure's replays side by side; the draws of r_end are dealt out over the structures."""
        found: list[Replayed] = []
        weights: list[Floats] = []
        first = 0
        live = [f for f in self.fits if f.key in self.shares]
        total = sum(self.predictions.weights[f.key] for f in live)
        for k, fit in enumerate(live):
            number = self.shares[fit.key]
            drawn = fit.thinned(number)
            ends = self.ends.part(first, number)
            replayer = FittedLinear(
                fit.key, LinearConfig(seed=self.config.seed), self.buffer, self.scale, fit.tables, drawn, drawn, ends, ends, None
            )
            found.append(replayer.replay(policies, drawn, ends, horizon))
            weights.append(np.full(number, self.predictions.weights[fit.key] / total / number))
            first += number
            report((k + 1) / len(live), "replaying sessions")
        return Replays(
            step_return=np.concatenate([r.step_return for r in found], axis=1),
            energy=np.concatenate([r.energy for r in found], axis=1),
            amplitude=np.concatenate([r.amplitude for r in found], axis=1),
            beta=np.concatenate([r.beta for r in found], axis=1),
            outcomes=np.concatenate([r.outcomes for r in found], axis=1),
            weights=np.concatenate(weights),
            summaries=self._summaries(found, np.concatenate(weights)),
            behaviour=tuple(_behaviour(found, i) for i in range(len(policies))),
        )

    def _summaries(self, found: Sequence[Replayed], weights: Floats) -> Floats:
        """Compute `support.SUMMARIES` of every policy, [P, 4], over sessions and draws."""
        each = []
        for r in found:
            each.append(np.stack([v.mean(-1) for v in (r.amplitude, r.late, r.above, r.switching)], axis=-1))  # [P, D, 4]
        return np.asarray(np.einsum("pds,d->ps", np.concatenate(each, axis=1), weights), dtype=np.float64)

    def _draws(self, replays: Replays, policies: Mapping[str, Policy], supports: Sequence[Support], horizon: int) -> Draws:
        alike = similarity(list(policies.values()), self.buffer.transitions().states)
        leverage = np.array([s.leverage for s in supports])
        c = self.config
        found = joint_draws(self.buffer, replays, self.ends, alike, leverage, horizon, c.seed, c.model_errors, c.common_share)
        if not self.tests:
            return found
        names, rng = list(policies), np.random.default_rng([self.config.seed, 0x7E57])
        return replace(
            found, values=updated(found.values, names, len(names) - 1, self.tests, found.between_visits, rng, self._parts, alike)
        )

    def _estimate(
        self, i: int, replays: Replays, draws: Draws, support: Support, common: dict[str, Any], noted: list[Flag], horizon: int
    ) -> Estimate:
        values = {name: rows[i] for name, rows in draws.values.items()}
        own, with_end = values["return"], self.ends.seen[0]
        low, high = (float(q) for q in np.quantile(own, [(1 - LEVEL) / 2, (1 + LEVEL) / 2]))
        shown = {name: np.clip(values[name], *LIMITS[name]) for name in QUANTITIES if name in values and name != "return"}
        flags = [*support.flags, *(f for f in noted if not f.refuses)]
        flags += [] if with_end else [FEW_END_REWARDS]
        flags += [draws.unknown] if draws.unknown else []
        moved = {"mean_amplitude": replays.amplitude, "mean_beta": replays.beta}
        return Estimate(
            method=self.method,
            value=float(own.mean()),
            low=low,
            high=high,
            level=LEVEL,
            standard_error=float(own.std(ddof=1)),
            step_return=float(values["steps"].mean()),
            end_reward=float(values["r_end"].mean()) if with_end else None,
            predicted={name: float(v.mean()) for name, v in shown.items()}
            | {name: float(v[i].mean(-1) @ replays.weights) for name, v in moved.items()},
            supported=support.supported,
            flags=distinct(flags),
            n=len(self.buffer.sessions),
            details={
                **common,
                "horizon_steps": horizon,
                "draws": [round(float(v), 4) for v in own],
                "outcome_draws": {name: [round(float(v), 4) for v in drawn] for name, drawn in shown.items()},
                "standard_errors": _apart(own, values[STATISTICAL]),
                "support": support.to_json(),
                "behaviour": replays.behaviour[i],
                "weights": {key: round(w, 4) for key, w in self.predictions.weights.items()},
                "tests": len(self.tests),
                "constants_version": VERSION,
            },
        )


def _apart(own: Floats, without_model_errors: Floats) -> dict[str, float]:
    """Split the standard errors of a return by their cause: `statistical`, too few sessions; `model_error`, what structures get wrong that
    far away.

    Before any test their squares add up to that of the whole but for chance. A test ties the two together, and the whole is less.
    """
    said = {"statistical": without_model_errors, "model_error": own - without_model_errors}
    return {name: round(float(drawn.std(ddof=1)), 4) for name, drawn in said.items()}


def _behaviour(found: Sequence[Replayed], i: int) -> dict[str, float]:
    """Summarise what policy i does in its replayed sessions, over all draws of all structures."""
    rows = sum(r.amplitude[i].size for r in found)

    def mean(name: str) -> float:
        return float(sum(getattr(r, name)[i].sum() for r in found) / rows)

    return {"below_cdbs_20_percent": mean("off"), "closeness_to_cdbs": mean("from_cdbs"), "mean_amplitude": mean("amplitude")}


def build(key: str, seed: int, size: Size) -> Posterior:
    """Build the estimator, as the registry asks for it: 32 draws for a first look, 48 for a study."""
    return Posterior(PosteriorConfig(seed=seed, draws=48 if size == "full" else 32), key)
