"""Assessment of every policy in one evaluation: its place, its verdict, what the data cover, and the results of its sessions."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from app.evaluation.estimates.coverage import coverage_by_policy, coverage_failed
from app.evaluation.estimates.service import estimate_of
from app.evaluation.ranking.decisions import Circumstances, Decided, decide, ordering_told, session_noise
from app.evaluation.repository import PolicyHead
from app.evaluation.schemas import CoverageOut, TestedBefore
from app.platform.errors import Invalid
from app.study import cdbs_amplitude
from app.tables.evaluations import Evaluation
from app.tables.participants import Participant, SettingsVersion
from ml.mdp import MdpSettings
from ml.ope import POSTERIOR, SETTLED_BY_SESSIONS, Estimate, Flag, rank_policies
from ml.ope.posterior.further_sessions import Place
from ml.outcomes import FIELDS
from ml.returns import ActualReturn, actual_return
from ml.trajectories import SessionTrajectory

# What sessions really brought, in the terms of the estimates: the same horizon H, the same discount, the same constants of the reward.

QUANTITIES = ("energy", "mean_beta", *FIELDS)
"""Quantities that methods predict besides the return and that sessions show: mean a^2, mean beta (participant's unit), outcomes."""


@dataclass(frozen=True)
class Actual(ActualReturn):
    """One session's result: its return, and `QUANTITIES` that it has, by name."""

    shown: dict[str, float] = field(default_factory=dict)

    @property
    def energy(self) -> float | None:
        """Mean of a^2 over the steps with a known amplitude; None where there is none."""
        return self.shown.get("energy")


def actual(session: SessionTrajectory, settings: MdpSettings, horizon_steps: int) -> Actual:
    """Compute a session's actual return over H steps; QoCs, energy and beta are of the whole session, whatever H is."""
    found = actual_return(session, settings, horizon_steps)
    return Actual(found.step_return, found.end_reward, _shown(session))


def _shown(session: SessionTrajectory) -> dict[str, float]:
    amplitude = session.amplitude[~np.isnan(session.amplitude)]
    beta = session.beta[~np.isnan(session.beta)]
    found = {
        "energy": float(np.mean(amplitude**2)) if amplitude.size else None,
        "mean_beta": float(beta.mean()) if beta.size else None,
        **{name: getattr(session.qoc, name) for name in FIELDS},
    }
    return {name: float(value) for name, value in found.items() if value is not None}


def mean_of(values: Sequence[float | None]) -> float | None:
    """Average the known values; None where there is none."""
    known = [v for v in values if v is not None]
    return float(np.mean(known)) if known else None


_NOT_BEST = ("unsafe", "likely_worse")
"""Verdicts of policies that are not asked for their probability of being best, like policies that the data do not support."""


@dataclass(frozen=True)
class Assessed:
    """One policy in an evaluation.

    Attributes:
        reference: `cdbs`, `constant`, `best_constant`, `proportional`, `cloning`; None for a candidate.
        estimate: by the ranking's method; None where it has none. estimates: of every method.
        rank: 1 is best; None for references, and where the data cannot order policies. probability_best: likewise.
        decided: the verdict; None for references. planned: the same for candidates, and for references the verdict that a plan uses; None
            for cDBS.
        coverage: None where nothing was checked. tested: None where it never ran.
    """

    policy: PolicyHead
    reference: str | None
    estimate: Estimate | None
    estimates: Mapping[str, Estimate]
    rank: int | None
    probability_best: float | None
    decided: Decided | None
    planned: Decided | None
    coverage: CoverageOut | None
    tested: TestedBefore | None = None

    @property
    def posterior(self) -> Estimate | None:
        """Posterior estimate, the basis of the verdict."""
        return self.estimates.get(POSTERIOR)


@dataclass(frozen=True)
class Assessment:
    """All policies of an evaluation: candidates, then references.

    Candidates are in the order of their values, those with a hazard last; by name where the data cannot order them.

    Attributes:
        method: whose estimates rank. cdbs_ma: the cDBS amplitude now, mA; None where it is not known or differs by side.
        ordered: whether the data can order policies.
    """

    evaluation: Evaluation
    participant: Participant
    method: str
    assessed: tuple[Assessed, ...]
    cdbs_ma: float | None
    ordered: bool

    @property
    def candidates(self) -> list[Assessed]:
        """Policies that are ranked."""
        return [a for a in self.assessed if a.reference is None]

    @property
    def references(self) -> list[Assessed]:
        """References that candidates are compared with."""
        return [a for a in self.assessed if a.reference is not None]

    @property
    def cdbs(self) -> Assessed | None:
        """The cDBS reference."""
        return next((a for a in self.assessed if a.reference == "cdbs"), None)

    @property
    def cdbs_id(self) -> int | None:
        """Id of the policy that holds the cDBS amplitude."""
        return self.cdbs.policy.id if self.cdbs else None

    @property
    def cdbs_estimates(self) -> Mapping[str, Estimate]:
        """Estimates of cDBS by method."""
        return self.cdbs.estimates if self.cdbs else {}

    @property
    def weights(self) -> Mapping[str, float]:
        """Weights of the structures behind the posterior, the same for all policies; empty where there is no posterior."""
        return self._posterior_detail("weights")

    @property
    def standard_errors(self) -> Mapping[int, Mapping[str, float]]:
        """By policy, those of its posterior return by their cause (`statistical`, `model_error`)."""
        known = {a.policy.id: a.posterior.details.get("standard_errors") for a in self.assessed if a.posterior is not None}
        return {policy_id: errors for policy_id, errors in known.items() if errors}

    @property
    def held_out_correlation(self) -> float | None:
        """Of predicted with observed rewards of left-out sessions; None where it is not known."""
        return self._posterior_detail("skill").get("held_out_correlation")

    @property
    def left_out_outcomes(self) -> Mapping[str, Mapping[str, float | None]]:
        """Skill of the predicted outcomes of held-out sessions and visits (`EndModel.predictability`); empty without a posterior."""
        return self._posterior_detail("left_out_outcomes")

    def _posterior_detail(self, name: str) -> Mapping[str, Any]:
        found = next((a.posterior for a in self.assessed if a.posterior is not None), None)
        return (found.details.get(name) or {}) if found is not None else {}

    def of(self, policy_id: int) -> Assessed | None:
        """Find one policy; None where the evaluation does not have it."""
        return next((a for a in self.assessed if a.policy.id == policy_id), None)

    def with_tests(self, tested: Mapping[int, TestedBefore]) -> Assessment:
        """Add the results of sessions, by policy."""
        return replace(self, assessed=tuple(replace(a, tested=tested.get(a.policy.id)) for a in self.assessed))


def assess(
    evaluation: Evaluation,
    policies: Mapping[int, PolicyHead],
    method: str,
    participant: Participant,
    version: SettingsVersion,
    cdbs_ma: float | None,
    harms: Mapping[int, tuple[Flag, ...]] | None = None,
) -> Assessment:
    """Assess the policies of an evaluation by one method, with the verdicts by the participant's present margins.

    Args:
        evaluation: with its estimates. policies: all of them, by id. method: whose estimates rank; one of the evaluation's.
        participant: whose. version: the settings that the evaluation rests on. cdbs_ma: as `cdbs_amplitude_now` gives it.
        harms: by policy, what happened under it that no clinician has cleared (`decisions.findings_of`); nothing where not given.
    """
    found_under = harms or {}
    table: dict[int, dict[str, Estimate]] = defaultdict(dict)
    for row in evaluation.estimates:
        table[row.policy_id][row.method] = estimate_of(row)
    coverage, by_method = coverage_by_policy(evaluation), {i: by[method] for i, by in table.items() if method in by}
    references = _references(policies, by_method)
    cdbs = next((table[i] for i, r in references.items() if r == "cdbs"), {})
    given = Circumstances(
        evaluation.id,
        evaluation.created_at,
        participant.margins_in_force,
        participant.current_margins,
        coverage_failed(evaluation),
        session_noise(evaluation),
        Place(version.bound, evaluation.horizon_steps, version.period_s),
        cdbs_ma,
        tuple((held, table[i][POSTERIOR]) for i in references if (held := policies[i].amplitude) is not None and POSTERIOR in table[i]),
    )
    by = evaluation.default_method
    candidates = {i: e for i, e in by_method.items() if i not in references}
    decided = {
        i: decide(table[i], cdbs, by, given, i, retired_reason=policies[i].retired_reason, harms=found_under.get(i, ())) for i in candidates
    }
    # a reference may be planned as any policy; how many sessions would settle it is not asked
    unasked = replace(given, noise={})
    planned = decided | {
        i: decide(table[i], cdbs, by, unasked, i, retired_reason=policies[i].retired_reason, harms=found_under.get(i, ()))
        for i, reference in references.items()
        if reference != "cdbs" and i in table
    }
    own = {i: by[POSTERIOR] for i, by in table.items() if POSTERIOR in by}
    ordered = ordering_told({i: e for i, e in own.items() if i not in references} or own)
    eligible = {str(i): replace(e, supported=e.supported and decided[i].decision not in _NOT_BEST) for i, e in candidates.items()}
    tiers = {str(i): _tier(decided[i], e) for i, e in candidates.items()}
    places = {int(r.policy): r for r in rank_policies({method: eligible}, method, tiers=tiers)} if candidates else {}
    order = sorted(places, key=lambda i: places[i].rank) if ordered else sorted(places, key=lambda i: (policies[i].name, i))
    order += sorted(references, key=lambda i: -(by_method[i].value if i in by_method else 0.0))
    found = tuple(
        Assessed(
            policies[i],
            references.get(i),
            by_method.get(i),
            table[i],
            places[i].rank if i in places and ordered else None,
            places[i].probability_best if i in places and ordered else None,
            decided.get(i),
            planned.get(i),
            coverage.get(i),
        )
        for i in order
    )
    return Assessment(evaluation, participant, method, found, cdbs_ma, ordered)


def _tier(verdict: Decided, estimate: Estimate) -> int:
    """Find the tier of a candidate, before its value counts: 2 with a hazard, 1 where the data refuse its estimate, else 0.

    A verdict is no tier. Nor is it one that few sessions came near a policy: on virtual patients its value still orders better than none.
    """
    if verdict.hazards or verdict.decision == "unsafe":
        return 2
    refusing = {flag.code for flag in estimate.flags if flag.refuses}
    return int(not estimate.supported and not (refusing and refusing <= SETTLED_BY_SESSIONS))


def _references(policies: Mapping[int, PolicyHead], by_method: Mapping[int, Estimate]) -> dict[int, str]:
    """Return the kinds of the policies that are not ranked; the best constant is so by its own estimate."""
    references = {i: _reference(p) for i, p in policies.items() if p.kind == "baseline"}
    constants = {i: by_method[i] for i, r in references.items() if r in ("cdbs", "constant") and i in by_method and by_method[i].supported}
    if constants:
        best = max(constants, key=lambda i: constants[i].value)
        if references[best] == "constant":
            references[best] = "best_constant"
    return references


def _reference(policy: PolicyHead) -> str:
    if policy.algorithm != "constant":
        return policy.algorithm
    return "cdbs" if policy.is_cdbs else "constant"


def cdbs_amplitude_now(participant: Participant) -> float | None:
    """Return the cDBS amplitude, mA; None where none is stated, or each side has its own: amplitudes are then shares of cDBS."""
    try:
        return cdbs_amplitude.in_force_now(participant, None)
    except Invalid:
        return None
