"""Making of the demo's files: policies are learned on a participant's earlier visits, and simulated sessions test them.

Everything is what the product computes: the training, distillation and gains are the functions that jobs run. The sessions before a
generation are those that it learns from. A fixed seed gives the same files on the same machine.
"""

from __future__ import annotations

import hashlib
import os
import tempfile
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from app import __version__
from app.evaluation.ranking.assessment import actual
from app.learning import training_compute
from app.learning.schemas import DEFAULT_SWEEP, DistilParams, TrainParams
from app.learning.training_configs import POLICY, distillation_config, generation_groups, policy_file, training_file, training_groups
from app.platform import files
from app.platform.errors import Invalid
from app.platform.jobs import StepReport
from app.platform.numbers import number
from app.settings import get_settings
from app.simulation.demo.data import DAY_WITH_POLICIES, Generation, LearnedPolicy, RecordedSession, Story, write
from app.simulation.demo.study import trajectories
from ml.mdp import MdpSettings
from ml.ope import PosteriorGain, Tests, TestSession, differences_to_cdbs, gains_over_cdbs, spread_of_random
from ml.outcomes import OUTCOMES
from ml.policies.onnx_policy import OnnxPolicy
from ml.population import PARTICIPANTS, run_session
from ml.population.outcomes import MEASURED
from ml.trajectories import ReplayBuffer, SessionTrajectory, to_parquet

HIDDEN = [40, 30]
"""Layers of the full-sized policies: a tenth of the paper's 400 and 300, so that the files are small."""
UPDATES, DISTIL_UPDATES = 3_000, 3_000
FRESH, TUNED = 4, 1
"""Policies from scratch in a generation, and those that go on from the best tested one."""
SURELY_WITHIN = 0.9
"""Probability that all outcomes keep within the margins, from which a policy is tested that saves the most."""
BETA_DECIMALS = 4
Say = Callable[[str], None]


@dataclass(frozen=True)
class Size:
    """One participant of the demo.

    Attributes:
        policy_visits: that test policies. generations: visits before which something is learned. seed: of what is learned.
    """

    policy_visits: tuple[int, ...]
    generations: tuple[int, ...]
    seed: int


STUDY = {
    "P2": Size((), (4,), 1),
    "P3": Size((3, 4, 5, 6), (3, 5), 1),
    "P4": Size((3, 4, 5, 6), (3, 5), 1),
}


@dataclass
class _Candidate:
    """A learned policy with what the next steps need of it."""

    policy: LearnedPolicy
    number: int
    sha256: str
    training_sha256: str | None
    sessions: int = 0


@dataclass
class _Participant:
    """The study of one participant, as it grows."""

    code: str
    size: Size
    say: Say
    trajectories: list[SessionTrajectory] = field(default_factory=list)
    candidates: list[_Candidate] = field(default_factory=list)
    generations: list[Generation] = field(default_factory=list)
    recorded: list[RecordedSession] = field(default_factory=list)
    kept: set[str] = field(default_factory=set)

    @property
    def settings(self) -> MdpSettings:
        return PARTICIPANTS[self.code].mdp_settings()

    def buffer(self) -> ReplayBuffer:
        return ReplayBuffer(self.settings, tuple(self.trajectories), "uV", "time_domain")

    def run(self) -> Story:
        """Run all visits in order."""
        self.trajectories += trajectories(self.code)
        for visit in sorted({*self.size.policy_visits, *self.size.generations}):
            if visit in self.size.generations:
                self._learn(visit)
            if visit in self.size.policy_visits:
                self._hold(visit)
        kept = [replace(g, policies=tuple(p for p in g.policies if p.name in self.kept)) for g in self.generations]
        return Story(self.code, __version__, self.size.seed, tuple(kept), tuple(self.recorded))

    def _learn(self, visit: int) -> None:
        """Train, judge, choose what the visit tests, and distil that."""
        buffer = self.buffer()
        sha256 = _keep(to_parquet(buffer))
        tests = self._tests(buffer)
        seed = self.size.seed + 100 * visit
        asked = TrainParams.model_validate(
            DEFAULT_SWEEP | {"preset": "quick", "count": FRESH, "updates": UPDATES, "seed": seed, "algorithms": ["rebrac"]}
        )
        parents = self._parents(buffer, tests)
        starts = [
            {
                "policy_id": one.number,
                "algorithm": one.policy.algorithm,
                "trained_with": {
                    k: one.policy.config[k]
                    for k in ("aim", "anchor", "anchor_amplitude", "alpha", "actor_penalty")
                    if k in one.policy.config
                },
                "checkpoint_sha256": one.training_sha256,
            }
            for one in parents
        ]
        groups = generation_groups(asked, starts, TUNED) if starts else training_groups(asked, [None] * FRESH)
        new: list[_Candidate] = []
        for group in groups:
            call: dict[str, Any] = {
                "snapshot_sha256": sha256,
                "held_out": asked.held_out,
                "margins": None,
                "tested": None,
                "algorithm": group["algorithm"],
                "configs": [one | {"hidden": HIDDEN, "device": "cpu"} for one in group["configs"]],
            }
            if group["start"]:
                call["initial"] = {"checkpoint_sha256": group["start"]["checkpoint_sha256"]}
            with _folder() as folder:
                result = training_compute.train(call, folder, _silent())
                for k, member in enumerate(result["members"]):
                    onnx = (folder / policy_file(k)).read_bytes()
                    learned = LearnedPolicy(
                        name=f"rl-{1 + sum(c.policy.kind == 'trained' for c in (*self.candidates, *new)):02d}",
                        kind="trained",
                        algorithm=group["algorithm"],
                        teacher=None,
                        parent=next((p.policy.name for p in parents if group["start"] and p.number == group["start"]["policy_id"]), None),
                        config=member["config"],
                        metrics=member["metrics"],
                        onnx=onnx,
                    )
                    trained = _keep((folder / training_file(k)).read_bytes())
                    new.append(_Candidate(learned, 1 + len(self.candidates) + len(new), _keep(onnx), trained))
        everyone = [*self.candidates, *new]
        gains = self._gains(buffer, tests, [c for c in everyone if c.policy.kind == "trained"])
        chosen = self._choose(everyone, gains, visit)
        known = next((c for c in everyone if c.policy.teacher == chosen.policy.name), None)
        student = known or self._distil(sha256, chosen, seed, len(everyone) + 1)
        self.candidates += [*new, *([] if known else [student])]
        tuned = [c for c in new if c.policy.parent]
        best_tuned = max(tuned, key=lambda c: gains[c.policy.name].gain.value, default=None)
        self.kept |= {c.policy.name for c in (chosen, student, best_tuned) if c is not None}
        made = [c.policy for c in new] + ([] if known else [student.policy])
        self.generations.append(Generation(visit, len(self.trajectories), tuple(made), (chosen.policy.name, student.policy.name)))

    def _distil(self, sha256: str, teacher: _Candidate, seed: int, number: int) -> _Candidate:
        asked = DistilParams(preset="quick", updates=DISTIL_UPDATES, seed=seed)
        with _folder() as folder:
            call = {"snapshot_sha256": sha256, "teacher_sha256": teacher.sha256, "config": distillation_config(asked, 0)}
            result = training_compute.distil(call, folder, _silent())
            onnx = (folder / POLICY).read_bytes()
        learned = LearnedPolicy(
            name=f"{teacher.policy.name}-small",
            kind="distilled",
            algorithm="distillation",
            teacher=teacher.policy.name,
            parent=None,
            config=result["config"],
            metrics=result["metrics"],
            onnx=onnx,
        )
        return _Candidate(learned, number, _keep(onnx), None)

    def _parents(self, buffer: ReplayBuffer, tests: Tests) -> list[_Candidate]:
        """Choose the tested full-sized policy with the highest gain, to go on from; none before any test."""
        ran = [c for c in self.candidates if c.sessions and c.training_sha256]
        if not ran:
            return []
        gains = self._gains(buffer, tests, ran)
        return sorted(ran, key=lambda c: -gains[c.policy.name].gain.value)[:1]

    def _gains(self, buffer: ReplayBuffer, tests: Tests, ran: list[_Candidate]) -> dict[str, PosteriorGain]:
        window = self.settings.window
        return gains_over_cdbs(buffer, {c.policy.name: OnnxPolicy(c.policy.onnx, window) for c in ran}, tests=tests)

    def _choose(self, everyone: list[_Candidate], gains: Mapping[str, PosteriorGain], visit: int) -> _Candidate:
        """Choose the full-sized policy to test: the one that saves most among those that surely keep the margins, if there are any."""
        trained = [c for c in everyone if c.policy.kind == "trained"]
        for c in trained:
            g = gains[c.policy.name]
            self.say(
                f"{self.code} before visit {visit}: {c.policy.name}, {c.policy.algorithm}, saves {g.saves or 0:.2f}, "
                f"within the margins {g.within or 0:.2f}{'' if g.supported else ', not supported'}{'' if g.told else ', no skill'}"
            )
        supported = [c for c in trained if gains[c.policy.name].supported] or trained
        sure = [c for c in supported if (gains[c.policy.name].within or 0.0) >= SURELY_WITHIN]
        if sure:
            return max(sure, key=lambda c: gains[c.policy.name].saves or 0.0)
        return max(supported, key=lambda c: gains[c.policy.name].expected_saving or -1.0)

    def _hold(self, visit: int) -> None:
        """Simulate the sessions of a visit, as its plan has them."""
        names = self.generations[-1].tested
        model = PARTICIPANTS[self.code]
        for k, slot in enumerate(DAY_WITH_POLICIES):
            tested = next(c for c in self.candidates if c.policy.name == names[slot.policy]) if slot.policy is not None else None
            steps = round(slot.minutes * 30)
            ran = run_session(
                self.code,
                slot.controller if tested is None else OnnxPolicy(tested.policy.onnx, self.settings.window),  # type: ignore[arg-type]
                visit=visit,
                hour=slot.start_minute / 60,
                seed=1000 * visit + k + 1,
                steps=steps,
                lead_steps=self.settings.window,
                resolution_ma=0.1,
            )
            ma = np.round(ran.amplitude * model.cdbs_amplitude_ma, 1)
            one = RecordedSession(
                visit=visit,
                position=k + 1,
                controller=slot.controller if tested is None else ("distilled" if tested.policy.kind == "distilled" else "rl"),
                policy=tested.policy.name if tested else None,
                start_minute=slot.start_minute,
                lead_beta=np.round(ran.lead_beta, BETA_DECIMALS),
                beta=np.round(ran.beta, BETA_DECIMALS),
                amplitude_ma=ma,
                qoc=asdict(ran.qoc),
            )
            self.recorded.append(one)
            self.trajectories.append(one.trajectory(len(self.trajectories) + 1, model.cdbs_amplitude_ma, tested.number if tested else None))
            if tested:
                tested.sessions += 1
            self.say(
                f"{self.code} visit {visit}: {one.policy or one.controller}, energy {np.mean((ma / model.cdbs_amplitude_ma) ** 2):.2f}, "
                f"{', '.join(f'{o.noun} {number(getattr(ran.qoc, o.field))} {o.entry_unit}' for o in OUTCOMES if o.field in MEASURED)}"
            )

    def _tests(self, buffer: ReplayBuffer) -> Tests:
        """Collect the results of tested sessions so far."""
        horizon = int(np.median([s.steps for s in self.trajectories]))
        shown = [
            TestSession(None if s.policy_id is None else str(s.policy_id), s.visit, _values(s, self.settings, horizon))
            for s in self.trajectories
            if s.controller == "cdbs" or s.policy_id is not None
        ]
        found = differences_to_cdbs(shown, spread_of_random(buffer, horizon))
        by_number = {str(c.number): OnnxPolicy(c.policy.onnx, self.settings.window) for c in self.candidates if c.sessions}
        return Tests(tuple(found.tests), by_number)


def _values(session: SessionTrajectory, settings: MdpSettings, horizon: int) -> dict[str, float]:
    result = actual(session, settings, horizon)
    values = {name: v for name, v in result.shown.items() if name != "mean_beta"}
    if result.value is not None:
        values["return"] = result.value
    return values


def make(folder: Path, codes: Sequence[str], say: Say, seed: int | None = None) -> list[Path]:
    """Make the files of the demo's participants.

    Args:
        folder: where they go. codes: of which participants. say: called with each line of progress. seed: in place of the stated ones.

    Raises:
        Invalid: a participant of whom the demo stores nothing.
    """
    unknown = [code for code in codes if code not in STUDY]
    if unknown:
        raise Invalid(f"The demo stores no files of '{unknown[0]}'.", f"Choose from {','.join(STUDY)}.")
    made = []
    with _scratch():
        for code in codes:
            size = STUDY[code] if seed is None else replace(STUDY[code], seed=seed)
            made.append(write(folder, _Participant(code, size, say).run()))
    return made


@contextmanager
def _scratch() -> Iterator[None]:
    """Use a temporary data folder for the files that computations hand to one another."""
    before = os.environ.get("BETALOOP_DATA_DIR")
    with tempfile.TemporaryDirectory(prefix="betaloop-demo-") as folder:
        os.environ["BETALOOP_DATA_DIR"] = folder
        get_settings.cache_clear()
        try:
            yield
        finally:
            if before is None:
                del os.environ["BETALOOP_DATA_DIR"]
            else:
                os.environ["BETALOOP_DATA_DIR"] = before
            get_settings.cache_clear()


@contextmanager
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="betaloop-step-") as folder:
        yield Path(folder)


def _keep(content: bytes) -> str:
    sha256 = hashlib.sha256(content).hexdigest()
    path = files.path_of(sha256)
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_bytes(content)
    return sha256


def _silent() -> StepReport:
    return StepReport(lambda _: None)
