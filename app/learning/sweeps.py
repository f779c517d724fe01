"""Sweeps: policies trained in one action, compared on sessions that they did not learn from."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from sqlalchemy.orm import Session

from app.learning import repository
from app.learning.policies import free_name
from app.learning.training_configs import CLONE, policy_file, training_file
from app.platform import files
from app.platform.jobs.service import code_version
from app.platform.numbers import counted
from app.platform.web.charts import Chart, axis, figure
from app.study import repository as study_repository
from app.tables.learning import BufferSnapshot, Policy, Sweep
from ml.ope import surest
from ml.policies.logged_range import LARGEST_SHARE_BELOW
from ml.returns import Gain

# Comparison of the policies of a sweep: on held-out sessions, with each other and with controllers without learning.

PALETTE = ("token:rl", "token:distilled", "token:random", "token:cdbs", "token:no_dbs", "token:other", "token:accent", "token:warn")
DASHES = ("solid", "dash", "dot")
CURVES = (
    ("held_out", "score", "Held-out return", "reward; estimated on the sessions that were kept out of training"),
    ("held_out", "over_logged", "Promised return beyond the recorded one", "reward; at the first states of the left-out sessions"),
    ("curve", "mean_q", "Promised return of the policy", "reward; an unbounded climb is over-estimation"),
    ("curve", "action_distance", "Distance from the recorded amplitudes", "mean absolute difference, fraction of cDBS"),
)
"""Place of a curve in a policy's metrics, its name there, its title and unit."""


@dataclass(frozen=True)
class Candidate:
    """One policy of a sweep.

    Attributes:
        score: estimated return on the held-out sessions at the state that was chosen; None where none were held out.
        over_logged: mean Q of the held-out sessions' first states less the return logged from them, at the same state.
        action_distance: mean absolute difference from the logged amplitudes over the buffer's states, fraction.
        saturated: share of these states answered with next to 0 or 1.
        mean_amplitude: over the buffer's states, fraction.
        best_update: the update whose state was chosen; None: the last.
        rate: the policy's learning rate. seed: of its training.
        gain: estimated return less that of cDBS, with its lower bound; None where it was not estimated.
        by_posterior: whether the posterior estimated it; older sweeps have gains by fitted Q evaluation, which decide nothing.
        `supported`, `told`: whether sessions are near what the policy does, and whether they can order policies at all.
        within: probability that every known outcome keeps its margin. saves: share of cDBS's energy that the policy is predicted to save.
            expected_saving: their product. None where unknown, as in older sweeps.
        beyond: whether an outcome is as probably beyond its margin as makes a verdict *unsafe*; None where that was not asked.
        below: the lower bound B of the buffer's random sessions, and the share of its states answered with less; None where unknown.
    """

    policy: Policy
    score: float | None
    over_logged: float | None
    action_distance: float | None
    saturated: float | None
    mean_amplitude: float | None
    best_update: int | None
    rate: float | None
    seed: int | None
    gain: Gain | None
    below: tuple[float, float] | None
    by_posterior: bool = False
    supported: bool = True
    told: bool = True
    beyond: bool | None = None
    within: float | None = None
    saves: float | None = None
    expected_saving: float | None = None

    @property
    def standing(self) -> tuple[bool, float] | None:
        """Larger is better: the expected saving, or the gain where that is unknown; who is unsupported or probably beyond a margin is last.

        Energy hardly counts in the return of most participants, whose best policy by it is cDBS again. None where the posterior has not
        spoken, or the data cannot order policies.
        """
        if not self.by_posterior or not self.told or self.gain is None:
            return None
        return self.supported and not self.beyond, self.gain.value if self.expected_saving is None else self.expected_saving

    @property
    def leaves_the_logged_range(self) -> bool:
        """True where it requests less than the random controller was allowed to more often than `LARGEST_SHARE_BELOW`."""
        return self.below is not None and self.below[1] > LARGEST_SHARE_BELOW


def candidates(sweep: Sweep) -> list[Candidate]:
    """List the sweep's policies, the largest expected saving by the posterior first; last those without supporting sessions or beyond a
    margin.

    Older sweeps have no saving: the largest gain over cDBS comes first. Where the posterior has not estimated all of them, or the data
    cannot order policies, their score on held-out sessions decides. Where nothing was held out, the order of training stays.
    """
    found = [_candidate(p) for p in sweep.policies]
    if ordered_by_posterior(found):
        return sorted(found, key=lambda c: c.standing or (False, 0.0), reverse=True)
    return sorted(found, key=lambda c: -c.score if c.score is not None else float("inf"))


def ordered_by_posterior(found: Sequence[Candidate]) -> bool:
    """Decide whether the posterior orders all of them."""
    return bool(found) and all(c.standing is not None for c in found)


def ordered_by_saving(found: Sequence[Candidate]) -> bool:
    """Decide whether the posterior orders all of them by what they are expected to save, and not by the gain of the return."""
    return ordered_by_posterior(found) and all(c.expected_saving is not None for c in found)


def better_without_learning(found: Sequence[Candidate], baselines: Sequence[dict[str, Any]]) -> str | None:
    """Find the best controller without learning where it is above every policy of the sweep, else None. None too where nothing was
    estimated.

    By what orders the policies where that is the posterior, else by the scores on held-out sessions.
    """
    stored = {str(row["controller"]): row.get("gain_over_cdbs") for row in baselines}
    fit = {name: bool(g["supported"]) and not g.get("beyond_margin", False) for name, g in stored.items() if g is not None}
    by = "expected_saving" if ordered_by_saving(found) else "value"
    told = {name: (fit[name], float(g[by])) for name, g in stored.items() if g is not None and g["told"] and g.get(by) is not None}
    if ordered_by_posterior(found) and told:
        name = max(told, key=told.__getitem__)
        return name if told[name] > max(c.standing for c in found if c.standing is not None) else None
    scores = [c.score for c in found if c.score is not None]
    best = max(baselines, key=lambda row: row["score"], default=None)
    return str(best["controller"]) if best is not None and scores and best["score"] > max(scores) else None


def surely_above_cdbs(found: Sequence[Candidate]) -> Candidate | None:
    """Find the policy with the largest lower bound of its gain over cDBS by the posterior; None where no bound is above 0.

    Policies that are retired, that no session supports or that are probably beyond a margin are excluded. So are all where the data cannot
    order policies.
    """
    judged = {str(k): c for k, c in enumerate(found) if c.standing is not None and c.standing[0] and c.policy.retired_reason is None}
    name = surest({k: c.gain for k, c in judged.items() if c.gain is not None})
    return None if name is None else found[int(name)]


def held_near(config: Mapping[str, Any]) -> str | None:
    """Name the anchor of a policy's training, by its configuration: `logged`, `cDBS`, or such as `0.70 of cDBS`; None where there is
    none."""
    if config.get("anchor") != "constant":
        return config.get("anchor")
    amplitude = float(config.get("anchor_amplitude", 1.0))
    return "cDBS" if amplitude == 1.0 else f"{amplitude:.2f} of cDBS"


def below_bound(policy: Policy) -> tuple[float, float] | None:
    """Return the lower bound of the random sessions that a policy learned from, and how often it requests less; None where that is
    unknown."""
    stored = policy.metrics.get("below_bound")
    return None if stored is None else (float(stored["bound"]), float(stored["share"]))


def _candidate(policy: Policy) -> Candidate:
    held = policy.metrics.get("held_out", {})
    # Policies stored before the chosen state was measured have the figures of their last state.
    measured = policy.metrics.get("kept") or policy.metrics.get("last", {})
    at = _chosen(held, policy.metrics.get("best_update"))
    stored = dict(policy.metrics.get("gain_over_cdbs") or {})
    by, supported, told = stored.pop("by", None), stored.pop("supported", True), stored.pop("told", True)
    beyond, within, saves, expected = (stored.pop(name, None) for name in ("beyond_margin", "within", "saves", "expected_saving"))
    return Candidate(
        policy=policy,
        score=_at(held, "score", at),
        over_logged=_at(held, "over_logged", at),
        action_distance=measured.get("action_distance"),
        saturated=measured.get("saturated"),
        mean_amplitude=policy.metrics.get("mean_amplitude_on_buffer"),
        best_update=policy.metrics.get("best_update"),
        rate=policy.config.get("actor_lr"),
        seed=policy.seed,
        gain=Gain(**stored) if stored else None,
        below=below_bound(policy),
        by_posterior=by == "posterior",
        supported=supported,
        told=told,
        beyond=beyond,
        within=within,
        saves=saves,
        expected_saving=expected,
    )


def _chosen(held: dict[str, list[float]], best_update: int | None) -> int:
    """Find the index of the scoring whose state was chosen."""
    updates = held.get("update", [])
    return updates.index(best_update) if best_update in updates else len(updates) - 1


def _at(curves: dict[str, list[float]], name: str, index: int) -> float | None:
    values = curves.get(name)
    return values[index] if values else None


def charts(sweep: Sweep) -> list[Chart]:
    """Draw the learning curves of all policies of a sweep, one chart for each kind of curve that was recorded."""
    made = (_chart(sweep.policies, *curve) for curve in CURVES)
    return [chart for chart in made if chart is not None]


def _chart(policies: Sequence[Policy], place: str, name: str, title: str, unit: str) -> Chart | None:
    data: list[dict[str, Any]] = []
    rows: list[list[Any]] = []
    for k, policy in enumerate(policies):
        curves = policy.metrics.get(place, {})
        if not curves.get(name):
            continue
        line = {"color": PALETTE[k % len(PALETTE)], "dash": DASHES[k // len(PALETTE) % len(DASHES)], "width": 1.8}
        data.append({"type": "scatter", "mode": "lines", "name": policy.name, "x": curves["update"], "y": curves[name], "line": line})
        rows += [[policy.name, int(u), float(v)] for u, v in zip(curves["update"], curves[name], strict=True)]
    if not rows:
        return None
    return Chart(
        id=f"sweep-{name.replace('_', '-')}",
        title=title,
        subtitle=f"{unit} · n = {counted(len(data), 'policy', 'policies')}",
        figure=figure(data, xaxis=axis("Update"), yaxis=axis(""), showlegend=True, legend={"orientation": "h", "y": -0.3}),
        columns=["Policy", "Update", title],
        rows=rows,
        height=320,
    )


# Sweeps: which policies are trained in one action, where they are stored, and how they compare. The caller commits.

Group = dict[str, Any]
"""Policies trained side by side in one child process: `key`, `algorithm`, `configs`, `start` (None from scratch)."""


def store(
    db: Session,
    *,
    job_id: str,
    created_by: str,
    snapshot: BufferSnapshot,
    name: str | None,
    config: dict[str, Any],
    groups: Sequence[Group],
    results: Sequence[dict[str, Any]],
    workdirs: Sequence[Path],
    baselines: tuple[dict[str, Any], Path],
) -> list[Policy]:
    """Store a sweep and its policies; a job that has stored its sweep already gets those policies again.

    Args:
        db: the session.
        job_id, created_by: the job and who submitted it.
        snapshot: what the policies were trained on.
        name: of the sweep; numbered where None or taken.
        config: what was asked for.
        groups, results, workdirs: one for each child process, in one order.
        baselines: result and folder of the step that scored controllers without learning.
    """
    repository.lock_participant(db, snapshot.participant_id)
    known = repository.sweep_of_job(db, job_id)
    if known is not None:
        return list(known.policies)
    sweep = Sweep(
        participant_id=snapshot.participant_id,
        name=_free_sweep_name(db, snapshot.participant_id, name),
        snapshot_id=snapshot.id,
        job_id=job_id,
        config=config,
        baselines=baselines[0],
        code_version=code_version(),
        created_by=created_by,
    )
    db.add(sweep)
    db.flush()
    rows = [
        _policy(db, sweep, snapshot, group, member, result["members"][member], workdir)
        for group, result, workdir in zip(groups, results, workdirs, strict=True)
        for member in range(len(group["configs"]))
    ]
    _store_clone(db, sweep, snapshot, baselines[1])
    return rows


def _policy(
    db: Session, sweep: Sweep, snapshot: BufferSnapshot, group: Group, member: int, result: dict[str, Any], workdir: Path
) -> Policy:
    number = repository.trained_count(db, snapshot.participant_id) + 1
    start = group["start"]
    row = Policy(
        participant_id=snapshot.participant_id,
        name=free_name(db, snapshot.participant_id, f"rl-{number:02d}"),
        kind="trained",
        algorithm=group["algorithm"],
        parent_id=start["policy_id"] if start else None,
        snapshot_id=snapshot.id,
        settings_version_id=snapshot.settings_version_id,
        job_id=sweep.job_id,
        job_step=f"{group['key']}/{member}",
        sweep_id=sweep.id,
        config=result["config"],
        seed=result["config"]["seed"],
        metrics=result["metrics"],
        onnx_sha256=files.store(db, (workdir / policy_file(member)).read_bytes()).sha256,
        checkpoint_sha256=files.store(db, (workdir / training_file(member)).read_bytes()).sha256,
        code_version=code_version(),
        created_by=sweep.created_by,
    )
    db.add(row)
    db.flush()
    return row


def _store_clone(db: Session, sweep: Sweep, snapshot: BufferSnapshot, workdir: Path) -> None:
    """Store the clone of the logged behaviour as a baseline of this snapshot, once."""
    name = f"behaviour clone of snapshot {snapshot.id}"
    if repository.policy_by_name(db, snapshot.participant_id, name):
        return
    window = study_repository.settings_version(db, snapshot.settings_version_id).window
    db.add(
        Policy(
            participant_id=snapshot.participant_id,
            name=name,
            kind="baseline",
            algorithm="cloning",
            snapshot_id=snapshot.id,
            settings_version_id=snapshot.settings_version_id,
            config={"controller": "cloning", "window": window},
            metrics={},
            onnx_sha256=files.store(db, (workdir / CLONE).read_bytes()).sha256,
            code_version=code_version(),
            created_by=sweep.created_by,
        )
    )
    db.flush()


def _free_sweep_name(db: Session, participant_id: int, wish: str | None) -> str:
    taken = repository.sweep_names(db, participant_id)
    if wish and wish.strip() and wish.strip() not in taken:
        return wish.strip()
    stem = wish.strip() if wish and wish.strip() else "sweep"
    numbers = (f"{stem[:90]} {n}" for n in range(1 if stem == "sweep" else 2, len(taken) + 3))
    return next(name for name in numbers if name not in taken)
