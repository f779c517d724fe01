"""Results of policies' sessions, for the posterior: of every policy that ran, candidate or not."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import asdict, dataclass
from typing import Any

from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.evaluation import repository
from app.evaluation.ranking.assessment import actual
from app.evaluation.ranking.results import DrivenSession, driven_sessions
from app.learning.policies import onnx_of, window_of
from app.platform.errors import Invalid
from app.tables.learning import BufferSnapshot, Policy
from ml.mdp import MdpSettings
from ml.ope import QUANTITIES, TestSession, differences_to_cdbs, spread_of_random
from ml.trajectories import ReplayBuffer


@dataclass(frozen=True)
class Tested:
    """Tested sessions as differences to the same visit's cDBS.

    Attributes:
        tests: fields of `TestedDifference`, JSON-able; a policy goes by its id.
        policies: that the tests are of, by id: retired ones too, because what they showed holds for those that act alike.
        left_out: sessions that are not among the tests, as arguments of `ml.ope.flags.not_counted_tests`.
    """

    tests: list[dict[str, Any]]
    policies: dict[int, Policy]
    left_out: dict[str, int]

    def beside(self, evaluated: Collection[int]) -> list[dict[str, Any]]:
        """Return the policies that are not evaluated themselves, as [{`id`, `sha256`}]: they are replayed besides those that are."""
        return [{"id": p.id, "sha256": p.onnx_sha256} for p in self.policies.values() if p.id not in evaluated]


def tested(db: Session, snapshot: BufferSnapshot, buffer: ReplayBuffer, horizon_steps: int, caller: Caller) -> Tested:
    """Collect the results of policies and cDBS in confirmed sessions, under the settings of a snapshot.

    Args:
        db: the session. snapshot: what the estimates rest on. buffer: the same, read. horizon_steps: of the estimates.
        caller: decides which arms may be known.
    """
    ran = [s for s in driven_sessions(db, snapshot, caller) if s.trajectory is not None]
    rows = repository.policies_by_id(db, sorted({s.policy_id for s in ran if s.policy_id is not None}))
    usable = {i: policy for i, policy in rows.items() if replayable(policy, buffer.settings.window)}
    counted = [s for s in ran if s.policy_id is None or s.policy_id in usable]
    sessions = [_shown(s, buffer.settings, horizon_steps) for s in counted]
    found = differences_to_cdbs(sessions, spread_of_random(buffer, horizon_steps))
    named = {test.policy_name for test in found.tests}
    return Tested(
        tests=[asdict(test) for test in found.tests],
        policies={i: policy for i, policy in usable.items() if str(i) in named},
        left_out={
            "without_cdbs": found.without_cdbs,
            "of_unknown_noise": found.of_unknown_noise,
            "without_policy": len(ran) - len(counted),
        },
    )


def replayable(policy: Policy, window: int) -> bool:
    """Check whether a policy can be replayed on windows of that many beta amplitudes; not where its file is gone."""
    try:
        onnx_of(policy)
        return window_of(policy) == window
    except Invalid:
        return False


def _shown(session: DrivenSession, settings: MdpSettings, horizon_steps: int) -> TestSession:
    trajectory = session.trajectory
    if trajectory is None:
        raise ValueError(f"session {session.session_id} has no steps: {session.left_out}")
    result = actual(trajectory, settings, horizon_steps)
    # a session that was stopped is a failure here as it is in buffers, whatever was measured
    counted = {name: v for name, v in asdict(trajectory.counted_qoc).items() if v is not None}
    values = {name: v for name, v in (result.shown | counted).items() if name in QUANTITIES}
    if result.value is not None:
        values["return"] = result.value
    return TestSession(None if session.policy_id is None else str(session.policy_id), session.visit, values)
