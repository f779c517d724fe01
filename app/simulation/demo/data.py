"""Files of the demo: policies that its later participants have tested, and the sessions that they ran, as stored with the package."""

from __future__ import annotations

import io
import json
import zipfile
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ml.qoc import Qoc
from ml.trajectories import SessionTrajectory

Floats = NDArray[np.float64]
FOLDER: Final = Path(__file__).parent / "files"
MOST_BYTES: Final = 300_000
_PERIOD_S = 2
_STORY = "story.json"
_DATED = (2026, 1, 1, 0, 0, 0)


@dataclass(frozen=True)
class Slot:
    """One session of a visit that tests policies. policy: its place among the tested ones; None for cDBS and no DBS."""

    controller: str
    policy: int | None
    minutes: float
    start_minute: float


SESSION_MINUTES: Final = 5.0
WASHOUT_MINUTES: Final = 5.0
REPEATS: Final = 3
"""Sessions of each policy at a visit."""


def _day() -> tuple[Slot, ...]:
    """Lay out a day as a plan does: a policy and its student in turn, cDBS between any two, and no DBS at the end."""
    order: list[tuple[str, int | None]] = []
    for k in range(2 * REPEATS):
        order += [("cdbs", None)] if k else []
        order.append(("policy", k % 2))
    order.append(("no_dbs", None))
    between = SESSION_MINUTES + WASHOUT_MINUTES
    return tuple(Slot(controller, policy, SESSION_MINUTES, k * between) for k, (controller, policy) in enumerate(order))


DAY_WITH_POLICIES: Final = _day()


@dataclass(frozen=True)
class LearnedPolicy:
    """A policy that was learned when the files were made, with what it was stored with."""

    name: str
    kind: str
    algorithm: str
    teacher: str | None
    parent: str | None
    config: dict[str, Any]
    metrics: dict[str, Any]
    onnx: bytes


@dataclass(frozen=True)
class Generation:
    """Generation of policies, learned before a visit.

    Attributes:
        visit: the visit after it. sessions: number of first sessions that it was learned on. policies: new ones that are kept.
        tested: names in the order of the visit's plan.
    """

    visit: int
    sessions: int
    policies: tuple[LearnedPolicy, ...]
    tested: tuple[str, ...]


@dataclass(frozen=True)
class RecordedSession:
    """One session of a visit with policies. Beta in uV; amplitude in mA of each step."""

    visit: int
    position: int
    controller: str
    policy: str | None
    start_minute: float
    lead_beta: Floats
    beta: Floats
    amplitude_ma: Floats
    qoc: dict[str, float | None]

    def table(self, cdbs_ma: float) -> bytes:
        """Write the session's file for an upload: `t_s,beta,amplitude_ma`."""
        lead = self.lead_beta.size
        rows = [f"{_PERIOD_S * (i - lead + 1)},{beta:.4f},{cdbs_ma:.1f}" for i, beta in enumerate(self.lead_beta)]
        rows += [
            f"{_PERIOD_S * (k + 1)},{beta:.4f},{ma:.1f}" for k, (beta, ma) in enumerate(zip(self.beta, self.amplitude_ma, strict=True))
        ]
        return "\n".join(["t_s,beta [uV],amplitude [mA]", *rows, ""]).encode()

    def trajectory(self, session_id: int, cdbs_ma: float, policy_id: int | None) -> SessionTrajectory:
        """Return the session as learning reads it."""
        return SessionTrajectory(
            session_id=session_id,
            visit=self.visit,
            controller=self.controller,
            policy_id=policy_id,
            lead_beta=self.lead_beta,
            beta=self.beta,
            amplitude=self.amplitude_ma / cdbs_ma,
            qoc=Qoc(**self.qoc),
        )


@dataclass(frozen=True)
class Story:
    """Everything that is stored of one participant. made_by: version of betaloop. seed: of what was learned."""

    code: str
    made_by: str
    seed: int
    generations: tuple[Generation, ...]
    sessions: tuple[RecordedSession, ...]


def write(folder: Path, story: Story) -> Path:
    """Write a participant's file; the same story gives the same bytes."""
    members: dict[str, bytes] = {}
    generations = []
    for generation in story.generations:
        policies = []
        for policy in generation.policies:
            members[f"{policy.name}.onnx"] = policy.onnx
            policies.append({k: v for k, v in asdict(policy).items() if k != "onnx"})
        generations.append(
            {"visit": generation.visit, "sessions": generation.sessions, "policies": policies, "tested": list(generation.tested)}
        )
    sessions = []
    for s in story.sessions:
        sessions.append(
            {k: getattr(s, k) for k in ("visit", "position", "controller", "policy", "start_minute", "qoc")} | {"lead": s.lead_beta.size}
        )
        beta = np.round(np.concatenate([s.lead_beta, s.beta]) * 10_000).astype("<u4")
        ma = np.round(s.amplitude_ma * 10).astype("u1")
        members[f"{s.visit}-{s.position}.beta"] = _planes(beta)
        members[f"{s.visit}-{s.position}.ma"] = ma.tobytes()
    head = {"code": story.code, "made_by": story.made_by, "seed": story.seed, "generations": generations, "sessions": sessions}
    members[_STORY] = json.dumps(_short(head), separators=(",", ":")).encode()
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_LZMA) as archive:
        for name in sorted(members):
            archive.writestr(zipfile.ZipInfo(name, _DATED), members[name], zipfile.ZIP_LZMA)
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{story.code}.zip"
    path.write_bytes(sink.getvalue())
    return path


def read(code: str, folder: Path = FOLDER) -> Story:
    """Read a participant's file."""
    with zipfile.ZipFile(folder / f"{code}.zip") as archive:
        head = json.loads(archive.read(_STORY))
        generations = tuple(
            Generation(
                g["visit"],
                g["sessions"],
                tuple(LearnedPolicy(**p, onnx=archive.read(f"{p['name']}.onnx")) for p in g["policies"]),
                tuple(g["tested"]),
            )
            for g in head["generations"]
        )
        sessions = tuple(_session(archive, s) for s in head["sessions"])
    return Story(head["code"], head["made_by"], head["seed"], generations, sessions)


def _session(archive: zipfile.ZipFile, s: dict[str, Any]) -> RecordedSession:
    name = f"{s['visit']}-{s['position']}"
    planes = np.frombuffer(archive.read(f"{name}.beta"), dtype="u1").reshape(4, -1)
    beta = np.ascontiguousarray(planes.T).view("<u4")[:, 0] / 10_000
    ma = np.frombuffer(archive.read(f"{name}.ma"), dtype="u1") / 10
    lead = s["lead"]
    known = {k: s[k] for k in ("visit", "position", "controller", "policy", "start_minute", "qoc")}
    return RecordedSession(**known, lead_beta=beta[:lead], beta=beta[lead:], amplitude_ma=ma)


def _planes(values: NDArray[np.uint32]) -> bytes:
    """Group the bytes of all values by place: high bytes hardly change and so compress well."""
    return np.ascontiguousarray(values.view("u1").reshape(-1, 4).T).tobytes()


def _short(value: Any) -> Any:
    """Round numbers to six digits: curves are for the eye."""
    if isinstance(value, dict):
        return {k: _short(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_short(v) for v in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value
