"""Check of a port: is a converted copy the policy of a bundle? By its answers to the bundle's port vectors, and by nothing else."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ml.deploy.bundle import MODEL, OpenBundle, open_bundle, unpack
from ml.deploy.manifest import BundleError, BundleManifest
from ml.deploy.ports import windows as kinds
from ml.deploy.ports.answers import Answers, read_answers
from ml.deploy.ports.explanations import explain
from ml.deploy.ports.vectors import PORT_VECTORS, PortVectors, from_csv
from ml.deploy.ports.windows import Act
from ml.deploy.runtime.envelope import RANGE_TOLERANCE
from ml.deploy.runtime.network import MlpNetwork
from ml.deploy.vectors import TOLERANCE
from ml.policies.onnx_policy import OnnxPolicy

SAME, WITHIN, NOT = "same", "within", "not this policy"
MOST_MA = 0.05
"""A copy farther off than this is another policy: half of 0.1 mA, the step in which stimulators of the RC+S kind are set."""
FULL_RANGE = 0.05
"""A largest or least dose missed by this amplitude fraction is a fault of its own, however few windows show it."""
_BESIDE_DIFFERENCES = ("lost_sample", "lost_decision", "monotone")
"""Faults that do not say why complete windows differ."""


@dataclass(frozen=True)
class Fault:
    """One fault of a copy; `wording` makes the sentence.

    Attributes:
        code: `lost_sample`, `lost_decision`, `order`, `wrap`, `cut`, `rounded`, `unit`, `outside`, `full_dose`, `least_dose`,
            `no_answer`, `monotone`, `limits` or `differs`.
        value: a number or a name, as the sentence of the fault needs it.
        due: what it should be.
        low, high: range of the doses, mA.
        count: windows concerned.
    """

    code: str
    value: float | str | None = None
    due: float | None = None
    low: float | None = None
    high: float | None = None
    count: int = 0


@dataclass(frozen=True)
class KindDifference:
    """Difference of a kind of windows: how many, how many were answered, largest and mean, mA; None where none was compared."""

    kind: str
    windows: int
    answered: int
    worst_ma: float | None
    mean_ma: float | None


@dataclass(frozen=True)
class PortCheck:
    """Result of a check.

    Attributes:
        verdict: `same`, `within` or `not this policy`.
        worst_ma: largest difference, mA; None where nothing could be compared.
        faults: what makes it another policy, most serious first.
        by_kind: differences by kind of window. compared: `network`, `decision` or both.
        highest_ma, highest_due_ma, lowest_ma, lowest_due_ma: largest and least dose, answered and due, mA; None where none was.
        lost_windows, lost_numbers: windows with a lost sample, and how many of them got a number that would count as a dose.
        lost_low_ma, lost_high_ma: range of these doses, mA.
        monotone_due, monotone: whether the dose along the levels only rises or only falls, for the policy and for the copy.
        participant, policy_id, policy_name, cdbs_ma: of the bundle. bundle_sha256, model_sha256, vectors_sha256, answers_sha256: of the
            files compared.
    """

    verdict: str
    worst_ma: float | None
    faults: tuple[Fault, ...]
    by_kind: tuple[KindDifference, ...]
    compared: tuple[str, ...]
    highest_ma: float | None
    highest_due_ma: float | None
    lowest_ma: float | None
    lowest_due_ma: float | None
    lost_windows: int
    lost_numbers: int
    lost_low_ma: float | None
    lost_high_ma: float | None
    monotone_due: bool
    monotone: bool
    participant: str
    policy_id: int | None
    policy_name: str
    cdbs_ma: float
    bundle_sha256: str
    model_sha256: str
    vectors_sha256: str
    answers_sha256: str

    def to_json(self) -> dict[str, Any]:
        """Convert the check to JSON's types."""
        return asdict(self)

    @staticmethod
    def from_json(entries: dict[str, Any]) -> PortCheck:
        """Read what `to_json` wrote."""
        faults = tuple(Fault(**fault) for fault in entries["faults"])
        by_kind = tuple(KindDifference(**kind) for kind in entries["by_kind"])
        return PortCheck(**entries | {"faults": faults, "by_kind": by_kind, "compared": tuple(entries["compared"])})


def port_vectors(content: bytes, manifest: BundleManifest) -> PortVectors:
    """Read the port vectors of a verified bundle. Raises BundleError where it has none, and says why."""
    if manifest.schedule is not None:
        raise BundleError("the bundle holds a schedule and no network: there is nothing to port")
    files = unpack(content)
    if PORT_VECTORS not in files:
        why = "a blinded session's bundle hides its network" if "session.bin" in files else "it was made before ports were checked"
        raise BundleError(f"the bundle holds no {PORT_VECTORS}: {why}; take the bundle of the policy")
    return from_csv(files[PORT_VECTORS], manifest.window)


def check_port(content: bytes, bundle: OpenBundle, table: bytes) -> PortCheck:
    """Check a table of answers against a bundle.

    Args:
        content: of the bundle. bundle: the same, verified. table: CSV as `read_answers` takes it.

    Raises:
        BundleError: the bundle has no port vectors. AnswersError: the table cannot be used.
    """
    vectors, manifest = port_vectors(content, bundle.manifest), bundle.manifest
    files = unpack(content)
    model = files[MODEL]
    network = bundle.network if isinstance(bundle.network, MlpNetwork) else None
    act: Act = network.act if network is not None else OnnxPolicy(model, manifest.window).act
    result = compare(vectors, manifest, read_answers(table, vectors), act, network)
    return PortCheck(
        **result,
        participant=manifest.participant,
        policy_id=manifest.policy_id,
        policy_name=manifest.policy_name,
        cdbs_ma=manifest.cdbs_ma,
        bundle_sha256=hashlib.sha256(content).hexdigest(),
        model_sha256=hashlib.sha256(model).hexdigest(),
        vectors_sha256=hashlib.sha256(files[PORT_VECTORS]).hexdigest(),
        answers_sha256=hashlib.sha256(table).hexdigest(),
    )


def check_file(content: bytes, table: bytes) -> PortCheck:
    """Check as `check_port`, with the bundle as bytes. Raises as `open_bundle` too."""
    return check_port(content, open_bundle(content), table)


def compare(
    vectors: PortVectors, manifest: BundleManifest, answers: Answers, act: Act, network: MlpNetwork | None = None
) -> dict[str, Any]:
    """Compare answers with what is due; returns the entries of `PortCheck` that depend on them."""
    cdbs, whole = manifest.cdbs_ma, ~vectors.without_dose
    faults: list[Fault] = []
    differences = np.full(len(vectors.kind), np.nan)
    ends: dict[str, float | None] = dict.fromkeys(("highest_ma", "highest_due_ma", "lowest_ma", "lowest_due_ma"))
    lost: dict[str, Any] = {"lost_numbers": 0, "lost_low_ma": None, "lost_high_ma": None}
    monotone_due = monotone = False
    if answers.fraction is not None:
        fraction = answers.fraction
        differences = np.abs(fraction - vectors.dose) * cdbs
        lost = _of_lost(fraction[~whole], cdbs)
        faults += _of_network(vectors, fraction, answers.decided_ma is not None, act, network, cdbs)
        known = whole & np.isfinite(fraction)
        if known.any():
            ends = _ends(fraction[known], vectors.dose[known], cdbs)
        levels = np.array(vectors.kind) == kinds.LEVEL
        monotone_due, monotone = _monotone(vectors.dose[levels], 0.0), _monotone(fraction[levels], MOST_MA / cdbs)
        if monotone_due and not monotone:
            faults.append(Fault("monotone", count=int(levels.sum())))
        if lost["lost_numbers"]:
            faults.insert(0, Fault("lost_sample", low=lost["lost_low_ma"], high=lost["lost_high_ma"], count=lost["lost_numbers"]))
    if answers.decided_ma is not None:
        faults += _of_decisions(vectors, manifest, answers.decided_ma)
        differences = np.fmax(differences, np.abs(answers.decided_ma - vectors.decision_ma))
    compared = differences[np.isfinite(differences)]
    worst = float(compared.max()) if compared.size else None
    guarded = vectors.without_dose & (np.abs(vectors.decision_ma - cdbs) <= MOST_MA)
    off = differences[~guarded & np.isfinite(differences)]
    if worst is None or (np.any(off > MOST_MA) and all(f.code in _BESIDE_DIFFERENCES for f in faults)):
        faults.append(Fault("differs", value=float(off.max()) if off.size else None, count=int(np.sum(off > MOST_MA))))
    verdict = NOT if faults or worst is None else SAME if worst <= TOLERANCE * cdbs else WITHIN
    return {
        "verdict": verdict,
        "worst_ma": worst,
        "faults": tuple(faults),
        "by_kind": tuple(_by_kind(vectors, answers, differences)),
        "compared": tuple(name for name, given in zip(("network", "decision"), answers, strict=True) if given is not None),
        **ends,
        "lost_windows": int(np.sum(~whole)),
        **lost,
        "monotone_due": monotone_due,
        "monotone": monotone,
    }


def _of_network(
    vectors: PortVectors, fraction: NDArray[np.float64], with_decision: bool, act: Act, network: MlpNetwork | None, cdbs: float
) -> Iterator[Fault]:
    """List what is wrong with the network's answers to complete windows. `with_decision`: an envelope in front may leave windows out."""
    whole = ~vectors.without_dose
    answered = whole & np.isfinite(fraction)
    missing = int(np.sum(whole & ~np.isfinite(fraction)))
    if missing and not (with_decision and answered.any()):
        yield Fault("no_answer", count=missing)
    if not answered.any():
        return
    given, due = fraction[answered], vectors.dose[answered]
    if np.max(np.abs(given - due)) * cdbs > MOST_MA:
        found = explain(given, vectors.windows[answered], act, network, cdbs)
        if found is not None:
            yield Fault(found.code, value=found.value, count=int(np.sum(np.abs(given - due) * cdbs > MOST_MA)))
        elif (top := _right_up_to(vectors.windows[answered], np.abs(given - due) * cdbs)) is not None:
            yield Fault("cut", value=top, count=int(np.sum(np.abs(given - due) * cdbs > MOST_MA)))
    beyond = (given < -RANGE_TOLERANCE) | (given > 1 + RANGE_TOLERANCE)
    if beyond.any():
        yield Fault("outside", low=float(given.min()) * cdbs, high=float(given.max()) * cdbs, count=int(beyond.sum()))
    for code, reached, wanted in (("full_dose", given.max(), due.max()), ("least_dose", -given.min(), -due.min())):
        if wanted - reached > FULL_RANGE:
            yield Fault(code, value=abs(float(reached)) * cdbs, due=abs(float(wanted)) * cdbs)


def _right_up_to(windows: NDArray[np.float64], off_ma: NDArray[np.float64]) -> float | None:
    """Find the beta up to which every window is right and above which most are wrong; None where there is none."""
    tops = windows.max(axis=1)
    wrong = off_ma > MOST_MA
    if not wrong.any():
        return None
    first = float(tops[wrong].min())
    above, below = tops >= first, tops < first
    return float(tops[below].max()) if below.sum() >= 20 and wrong[above].mean() > 0.5 else None


def _of_lost(fraction: NDArray[np.float64], cdbs: float) -> dict[str, Any]:
    """Count the lost samples that got an ordinary dose. All on cDBS is a guard in front; outside [0, 1] the envelope sees it."""
    counted = fraction[(fraction >= -RANGE_TOLERANCE) & (fraction <= 1 + RANGE_TOLERANCE)]
    guarded = counted.size == fraction.size and bool(np.all(np.abs(counted - 1.0) <= TOLERANCE))
    if guarded or not counted.size:
        return {"lost_numbers": 0, "lost_low_ma": None, "lost_high_ma": None}
    return {"lost_numbers": counted.size, "lost_low_ma": float(counted.min()) * cdbs, "lost_high_ma": float(counted.max()) * cdbs}


def _of_decisions(vectors: PortVectors, m: BundleManifest, amplitudes: NDArray[np.float64]) -> Iterator[Fault]:
    """List what is wrong with whole decisions."""
    lost = vectors.without_dose
    guarded = lost & (np.abs(vectors.decision_ma - m.cdbs_ma) <= MOST_MA)  # the others are decided on imputed samples
    unsafe = guarded & ~(np.abs(amplitudes - m.cdbs_ma) <= MOST_MA)
    if unsafe.any():
        known = amplitudes[unsafe & np.isfinite(amplitudes)]
        low, high = (float(known.min()), float(known.max())) if known.size else (None, None)
        yield Fault("lost_decision", low=low, high=high, due=m.cdbs_ma, count=int(unsafe.sum()))
    missing = int(np.sum(~lost & ~np.isfinite(amplitudes)))
    if missing:
        yield Fault("no_answer", value="decision", count=missing)
    beyond = (amplitudes < m.min_ma - TOLERANCE * m.cdbs_ma) | (amplitudes > m.max_ma + TOLERANCE * m.cdbs_ma)
    if beyond.any():
        given = amplitudes[beyond & np.isfinite(amplitudes)]
        if given.size:
            yield Fault("limits", low=float(given.min()), high=float(given.max()), count=int(beyond.sum()))


def _ends(answers: NDArray[np.float64], due: NDArray[np.float64], cdbs: float) -> dict[str, float | None]:
    return {
        "highest_ma": float(answers.max()) * cdbs,
        "highest_due_ma": float(due.max()) * cdbs,
        "lowest_ma": float(answers.min()) * cdbs,
        "lowest_due_ma": float(due.min()) * cdbs,
    }


def _monotone(doses: NDArray[np.float64], slack: float) -> bool:
    """Decide whether doses only rise or only fall, by the slack; unanswered ones are passed over."""
    steps = np.diff(doses[np.isfinite(doses)])
    return bool(np.all(steps >= -slack) or np.all(steps <= slack))


def _by_kind(vectors: PortVectors, answers: Answers, differences: NDArray[np.float64]) -> Iterator[KindDifference]:
    given = answers.decided_ma if answers.fraction is None else answers.fraction
    kind = np.array(vectors.kind)
    for name in dict.fromkeys(vectors.kind):
        mine = kind == name
        compared = differences[mine & np.isfinite(differences)]
        answered = 0 if given is None else int(np.sum(np.isfinite(given[mine])))
        worst, mean = (float(compared.max()), float(compared.mean())) if compared.size else (None, None)
        yield KindDifference(name, int(mine.sum()), answered, worst, mean)
