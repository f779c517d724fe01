"""API types of learning."""

from __future__ import annotations

import re
from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Field

from app.platform.web.schemas import Int, Model, Number, Text
from app.tables.learning import GateChoice
from ml.rl import ALGORITHMS

Preset = Literal["full", "quick"]
_CONTROL = r"\x00-\x1f\x7f-\x9f"


def _printable(name: str) -> str:
    if re.search(f"[{_CONTROL}]", name):
        raise ValueError("a policy's name has no control characters, the zero character and line breaks among them")
    if not name.strip():
        raise ValueError("a policy's name has at least one visible character")
    return name


PolicyName = Annotated[
    str,
    Field(max_length=100, json_schema_extra={"pattern": rf"^[^{_CONTROL}]*[^\s{_CONTROL}][^{_CONTROL}]*$"}),
    AfterValidator(_printable),
]
SweepName = PolicyName
AlgorithmName = Literal["ddpg", "td3_bc", "rebrac", "iql", "cloning"]
PolicyIds = Annotated[list[Annotated[Int, Field(ge=1)]], Field(max_length=50)]


ALGORITHM_NAMES: dict[str, str] = {name: algorithm.title for name, algorithm in ALGORITHMS.items()} | {
    "distillation": "distillation", "constant": "constant", "proportional": "proportional", "external": "made elsewhere",
}  # fmt: skip
"""What pages call the algorithm of a policy: those that train, by the table of the learners, and where the others come from."""


Aim = Literal["steps", "return", "both"]
Anchor = Literal["logged", "cdbs", "best", "both", "all"]
DEFAULT_SWEEP: dict[str, Any] = {"algorithms": ["ddpg", "rebrac"], "aim": "both", "anchor": "all", "critic_memory": True}
"""Policies of a sweep by default: the paper's algorithm, and one kept near the logged amplitudes, near the best constant amplitude or near
cDBS. They are trained with and without a share of r_end. DDPG alone went below cDBS in all participants of the demo. The three anchors span
the energies, so that a visit has something to choose from. Near the best constant amplitude policies are kept twice, closely and with more
room: there most patients who respond have one that succeeds. The critics see past amplitudes.
"""


class SweepParams(Model):
    """Parameters of a sweep: several policies trained in one action. Omitted ones come from the preset."""

    preset: Preset = Field("full", description="`full`: sizes for a study; `quick`: for a first look.")
    sweep: SweepName | None = Field(None, description="Name of the sweep; numbered where omitted.")
    algorithms: Annotated[list[AlgorithmName], Field(min_length=1, max_length=5)] = Field(
        ["ddpg"], description="The policies are dealt to these in turn; from scratch only."
    )
    aim: Aim = Field(
        "steps",
        description="What the critics sum: step rewards, as in the paper; each step's share of r_end besides; or one and the other.",
    )
    anchor: Anchor = Field(
        "logged",
        description="Amplitudes that TD3+BC and ReBRAC keep the policy near. `logged`: the logged ones, as published. `cdbs`: the cDBS "
        "amplitude, left only where the values speak for it. `best`: the constant amplitude with the largest expected saving, alternately "
        "closely and with more room. It is chosen among those that sessions support and that probably keep all margins. That saving is "
        "energy saved times the probability that all QoCs keep within the margins. `both`: alternately logged and cDBS. `all`: all "
        "alternately. Other algorithms have no anchor. Where anchors alternate, a fine-tuned policy keeps its own, as firmly.",
    )
    critic_memory: bool = Field(
        False,
        description="Whether the critics see means of past amplitudes besides the beta window. The policy never does. A fine-tuned policy "
        "keeps what its critics had.",
    )
    policies: PolicyIds = Field(default_factory=list, description="Fine-tune from each of these; empty: train from scratch.")
    count: Int = Field(6, ge=1, le=24, description="Policies to train from scratch; the paper trains 6.")
    held_out: bool = Field(
        True, description="Leave a fifth of the sessions out of the training, and keep each policy as it was when they spoke best for it."
    )


class TrainParams(SweepParams):
    """Parameters of `train`."""

    updates: Int | None = Field(None, ge=1, le=1_000_000, description="Gradient steps of each policy.")
    batch: Int | None = Field(None, ge=1, le=4096, description="Transitions per gradient step.")
    actor_lr_low: Number | None = Field(None, gt=0, le=1, description="Lowest learning rate of the policies.")
    actor_lr_high: Number | None = Field(None, gt=0, le=1, description="Highest; in between they are spread evenly in the logarithm.")
    critic_lr: Number | None = Field(None, gt=0, le=1, description="Learning rate of the critic.")
    seed: Int = Field(0, ge=0, le=10**6, description="Seed of the first policy; the next ones count up.")


class DistilParams(Model):
    """Parameters of `distill`."""

    preset: Preset = Field("full", description="`full`: sizes for a study; `quick`: for a first look.")
    policies: PolicyIds = Field(default_factory=list, description="Teachers; empty: every trained policy without a student.")
    sigma: Number | None = Field(None, ge=0, le=10, description="Noise of synthetic states, as a share of beta's standard deviation.")
    updates: Int | None = Field(None, ge=1, le=1_000_000, description="Gradient steps of each student.")
    hidden: list[Annotated[Int, Field(ge=1, le=1024)]] | None = Field(
        None, min_length=1, max_length=6, description="Student's hidden layers."
    )
    seed: Int = Field(0, ge=0, le=10**6)


class SnapshotSessionOut(Model):
    """One session of a snapshot, or why it was excluded."""

    session_id: int
    beta_trace_id: int | None
    amplitude_trace_id: int | None
    decode_version: int | None
    qoc_id: int | None
    conditions_id: int | None = Field(description="Revision of the session's conditions; null in snapshots of older versions.")
    cdbs_amplitude_ma: float | None
    hours_since_dose: float | None = Field(description="From the last dose to the start; null where not known, and in earlier snapshots.")
    steps: int | None
    left_out_reason: str | None


class SnapshotOut(Model):
    """A buffer snapshot."""

    id: int
    participant: str
    settings_version: int
    characteristics_version: int | None = Field(description="Of the participant, when it was taken; null where nothing was stated.")
    pins_sha256: str
    file_sha256: str
    sessions: int
    steps: int
    median_steps: int
    beta_unit: str
    beta_source: str
    created_at: datetime
    created_by: str
    members: list[SnapshotSessionOut]


class PolicyOut(Model):
    """A policy."""

    id: int
    participant: str
    name: str
    kind: str
    algorithm: str
    teacher_id: int | None
    parent_id: int | None
    snapshot_id: int | None
    settings_version: int
    job_id: str | None
    config: dict[str, Any]
    seed: int | None
    metrics: dict[str, Any]
    onnx_sha256: str
    code_version: str
    created_at: datetime
    created_by: str
    retired_reason: str | None


class QocTestOut(Model):
    """One QoC of sessions of learned policies against those of the random controller."""

    qoc: str
    unit: str
    n_learned: int
    n_random: int
    median_learned: float | None
    median_random: float | None
    p_better: float | None = Field(description="One-sided rank-sum test, Holm-adjusted; null where there is not enough data.")
    p_worse: float | None
    note: str


class GateDecisionOut(Model):
    """Decision of a clinician, and its reason."""

    choice: GateChoice
    reason: str
    created_at: datetime
    created_by: str


class GateOut(Model):
    """Decision whether sessions of learned policies may enter the replay buffer."""

    open: bool
    grounds: str
    opened_by_test: bool
    tests: list[QocTestOut]
    decision: GateDecisionOut | None


class GateChange(Model):
    """A clinician's decision on the gate."""

    choice: GateChoice = Field(description="`open` or `shut` whatever the tests say; `test` follows the tests again.")
    reason: Text = Field(min_length=1, max_length=1000)


class SweepCandidateOut(Model):
    """One policy of a sweep."""

    policy_id: int
    name: str
    algorithm: str
    actor_lr: float | None
    seed: int | None
    best_update: int | None = Field(description="The update whose state was chosen; null: the last.")
    score: float | None = Field(description="Estimated return on the held-out sessions by fitted Q evaluation; null where none were.")
    over_logged: float | None = Field(description="Q of the held-out first states less the return logged from them.")
    action_distance: float | None = Field(description="Mean absolute difference from the logged amplitudes, fraction.")
    saturated: float | None = Field(description="Share of states answered with next to 0 or 1.")
    mean_amplitude: float | None
    gain_over_cdbs: float | None = Field(
        description="Estimated return less that of cDBS over the whole buffer, by `gain_method`; null where it was not estimated."
    )
    gain_low: float | None = Field(description="Its one-sided lower 95 % bound.")
    gain_method: Literal["posterior", "fqe"] | None = Field(
        description="What estimated the gain: `fqe` in older sweeps, whose order rests on the scores; null without a gain."
    )
    supported: bool | None = Field(description="Whether sessions lie near what the policy does; null where that was not asked.")
    beyond_margin: bool | None = Field(
        description="Whether an outcome is so probably worse than under cDBS by more than its margin that the verdict is `unsafe`. "
        "Null where not checked, or no outcome is known."
    )
    within_margins: float | None = Field(
        description="Probability that every known outcome keeps its margin against cDBS; null where that is not known."
    )
    energy_saved: float | None = Field(
        description="Share of cDBS's energy that the policy is predicted to save; null where that is not known. "
        "The policies are in the order of this times `within_margins`."
    )
    below_bound: float | None = Field(
        description="Share of the buffer's states answered with less than the lower bound of its random sessions; null without those."
    )


class BaselineScoreOut(Model):
    """A controller that learns nothing, or only to imitate, scored as the policies are."""

    controller: str
    score: float
    mean_amplitude: float
    gain_over_cdbs: float | None = Field(default=None, description="Estimated return less that of cDBS, by the posterior.")
    gain_low: float | None = Field(default=None, description="Its one-sided lower 95 % bound.")


class SweepOut(Model):
    """Policies trained in one action, the largest gain by the posterior first (in older sweeps the best score on held-out sessions)."""

    id: int
    participant: str
    name: str
    snapshot_id: int
    job_id: str
    config: dict[str, Any]
    held_out_sessions: list[int]
    candidates: list[SweepCandidateOut]
    baselines: list[BaselineScoreOut]
    code_version: str
    created_at: datetime
    created_by: str


class PolicyLabel(Model):
    """The name of a new policy, as a form sends it."""

    name: PolicyName


class PolicyChange(Model):
    """Change of a policy: retire it, or take it back; nothing else of a policy ever changes."""

    retired_reason: Text | None = Field(max_length=1000, description="Why it is no longer to be ranked or planned; null takes it back.")
