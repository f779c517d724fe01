"""Safeguards between a verdict and a visit: unsafe policies need a clinician's reason, tests with care their lowest amplitude."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from app.evaluation.ranking import verdict_wording
from app.evaluation.ranking.decisions import Decided
from app.planning.grounds import Grounds
from app.platform.errors import Conflict, Forbidden, Invalid
from app.tables.learning import Policy

ROUNDING = 1e-9


@dataclass(frozen=True)
class Safeguard:
    """Record of a plan on one policy.

    Attributes:
        verdict: the strictest of the ranking behind the plan and the newest one. It is *unsafe* after a serious adverse event, and None
            where nothing is known of the policy.
        min_fraction: lowest amplitude, fraction of cDBS; None where the plan states none. override_reason: a clinician's.
    """

    verdict: str | None = None
    min_fraction: float | None = None
    override_reason: str | None = None


def safeguards(
    found: Grounds, policies: Sequence[Policy], overrides: Mapping[int, str], limits: Mapping[int, float], *, may_override: bool
) -> dict[int, Safeguard]:
    """Build the plan's record of each policy.

    Args:
        found: what policies are planned by. policies: to test.
        overrides: reasons for unsafe policies, by id. limits: stated lowest amplitudes, by id.
        may_override: whether the author may approve plans.

    Raises:
        Invalid: an unsafe policy without a reason, two tests with care, or a limit below that of the verdict. Also a reason or limit for a
            policy that is not in the plan; `field` is its name in the form. Forbidden: a reason of a person who may not approve plans.
    """
    _all_planned(policies, overrides, limits)
    made, careful = {}, []
    for policy in policies:
        finding = found.of(policy.id)
        reason, limit = overrides.get(policy.id, "").strip() or None, limits.get(policy.id)
        held_back = finding.held_back if finding is not None else None
        if held_back is not None:
            _require_override(policy, held_back, reason, may_override)
        if finding is not None and finding.with_care:
            careful.append(policy)
            limit = _checked_limit(policy, finding.limit, limit)
        # a reason that nothing asks for is not kept: it would look as if something had been overridden
        made[policy.id] = Safeguard(finding.verdict if finding else None, limit, reason if held_back else None)
    if len(careful) > 1:
        words = f"{_names(careful)} are each to be tested with care; a visit takes one of them."
        raise Invalid(words, "Leave all but one out.", field="policy_ids")
    return made


def refuse_approval(found: Grounds, planned: Sequence[tuple[Policy, Safeguard]]) -> None:
    """Check a draft against the present verdicts: margins and later findings may have changed them since it was drafted.

    Raises:
        Conflict: a policy that is unsafe now and has no clinician's reason; two tests with care. Also a test with care without a lowest
            amplitude or with one below the verdict's.
    """
    careful = []
    for policy, stated in planned:
        finding = found.of(policy.id)
        if finding is None:
            continue
        if finding.held_back is not None and not stated.override_reason:
            raise Conflict(
                f"Policy '{policy.name}' is not to be run without a clinician's word: {_why(finding.held_back)}.",
                "Draft the visit again without it, or with the reason why it is tested all the same.",
            )
        if finding.with_care:
            careful.append(policy)
            limit = finding.limit
            if stated.min_fraction is None or (limit is not None and stated.min_fraction < limit - ROUNDING):
                least = f" of at least {limit:.2f} of the cDBS amplitude" if limit is not None else ""
                raise Conflict(
                    f"Policy '{policy.name}' is to be tested with care, and the plan states no lowest amplitude{least} for it.",
                    "Draft the visit again with that limit.",
                )
    if len(careful) > 1:
        raise Conflict(f"{_names(careful)} are each to be tested with care; a visit takes one of them.", "Draft the visit again with one.")


def _require_override(policy: Policy, decided: Decided, reason: str | None, may_override: bool) -> None:
    if reason is None:
        raise Invalid(
            f"Policy '{policy.name}' is not to be run without a clinician's word: {_why(decided)}.",
            "Leave it out, or have a clinician who may approve plans state why it is tested all the same.",
            field=f"override_{policy.id}",
        )
    if not may_override:
        raise Forbidden(f"Policy '{policy.name}' is unsafe; only those who may approve plans can plan it.", "Ask a clinician of the study.")


def _checked_limit(policy: Policy, least: float | None, stated: float | None) -> float | None:
    """Return the lowest amplitude of a test with care: the stated one, else the verdict's; never below that."""
    if stated is None or least is None:
        return least if stated is None else stated
    if stated < least - ROUNDING:
        raise Invalid(
            f"Policy '{policy.name}' may be tested down to {least:.2f} of the cDBS amplitude, not to {stated:.2f}: no two sessions "
            "held less.",
            "Leave the limit out, or raise it.",
            field=f"limit_{policy.id}",
        )
    return stated


def _all_planned(policies: Sequence[Policy], *stated: Mapping[int, object]) -> None:
    ids = {p.id for p in policies}
    for found in stated:
        stray = sorted(set(found) - ids)
        if stray:
            words = f"Policy {stray[0]} has a reason or a limit, but is not among the policies to test."
            raise Invalid(words, "Name it there too.", field="policy_ids")


def _why(decided: Decided) -> str:
    return verdict_wording.plainly(decided.hazards or decided.reasons)


def _names(policies: Sequence[Policy]) -> str:
    return " and ".join(f"'{p.name}'" for p in policies)
