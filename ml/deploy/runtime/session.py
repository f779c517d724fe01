"""One session on the tablet, the same for `betaloop control` and for the bundle's own runner: may it run, its log, its loop, its end."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np

from .control_loop import End, LiveSession
from .controller import BoundedController
from .decision_log import LogFailed, LogFile, seal_facts
from .envelope import BetaSample, Signal
from .inputs import Link
from .ledger import Attempt, Ledger
from .protocol import Peer
from .slot import NotAllowed, Refusal, Slot, Withdrawals

TIMED_DECISIONS = 200
"""Decisions that are timed before each session; they take some milliseconds together."""
POWER = Path("/sys/class/power_supply")
NETWORK = "model.onnx"
"""The file of a bundle by which a policy is known, in whatever installation."""
OF_LOG = (
    "participant", "hemisphere", "policy_id", "policy_name", "cdbs_ma", "min_ma", "max_ma", "ramp_ma_per_s", "window", "period_s",
)  # fmt: skip
"""Entries of the manifest that a log repeats."""
OF_BLINDED_LOG = (
    "participant", "hemisphere", "cdbs_ma", "period_s", "plan_id", "slot_id", "position", "visit_number", "visit_date", "minutes",
    "label", "plan_sha256", "issued_at", "purpose", "manifest_sha256", "started_at",
)  # fmt: skip
"""What the log of a blinded session says for all to read: which session it is, and not what ran."""


@dataclass(frozen=True, kw_only=True)
class Tablet:
    """Parts of the machine that a session needs.

    Attributes:
        ledger: which slots this tablet has run. withdrawn: a list that was brought along; None where none was.
        simulated: whether the device side is a simulation; its log says so, so that it is never taken for a participant's unseen.
        now: the local time with its offset.
    """

    ledger: Ledger
    withdrawn: Withdrawals | None = None
    simulated: bool = False
    now: Callable[[], datetime] = lambda: datetime.now().astimezone()


@dataclass(frozen=True)
class Outcome:
    """Outcome of a session: how it ended, in words where there are any, and the loop with its decisions."""

    end: End
    detail: str
    session: LiveSession


def slot_of(manifest: Mapping[str, Any]) -> Slot:
    """Return the slot of a bundle. Raises NotAllowed where it has none, as bundles that are taken without a plan."""
    stored = manifest.get("slot")
    if stored is None:
        raise NotAllowed(
            Refusal.NO_SLOT,
            "this bundle is for no session of a signed plan (it was made before there were slots, or without a plan) and runs on the bench "
            "alone: have the visit plan signed and take the session's bundle from it",
        )
    return Slot(**stored)


def check_allowed(manifest: Mapping[str, Any], tablet: Tablet, participant: str | None = None) -> Slot:
    """Find the slot that a bundle may run in now.

    Args:
        participant: who is there, where it was stated.

    Raises:
        NotAllowed: the plan is not signed, it is another participant's, another day, withdrawn, or the slot is used.
    """
    slot = slot_of(manifest)
    if not manifest.get("approvals"):
        raise NotAllowed(Refusal.NOT_SIGNED, "the plan of this bundle is not signed: it is not to be used on a participant")
    if participant is not None and participant != manifest["participant"]:
        message = f"the bundle is of participant {manifest['participant']}, not {participant}"
        raise NotAllowed(Refusal.OTHER_PARTICIPANT, message)
    now = tablet.now()
    tablet.ledger.check_clock(now)
    slot.check_day(now)
    if tablet.withdrawn is not None:
        tablet.ledger.withdraw(tablet.withdrawn)
    withdrawn = tablet.ledger.withdrawn()
    if withdrawn is not None:
        withdrawn.check(slot, manifest.get("policy_id"))
    tablet.ledger.check_unused(manifest["participant"], slot)
    return slot


def run_slot(
    manifest: Mapping[str, Any],
    manifest_sha256: str,
    controller: BoundedController,
    link: Link,
    log: Path,
    tablet: Tablet,
    participant: str | None = None,
) -> Outcome:
    """Run a bundle's session with a device side. Its slot is used once the policy or schedule has decided.

    Args:
        manifest: as JSON gives it. manifest_sha256: of its bytes. controller: within its envelope. log: a new file. participant: who is
            there, where it was stated.

    Raises:
        NotAllowed: it may not run; nothing was sent but the refusal. LogFailed: the log cannot be begun.
    """
    try:
        slot = check_allowed(manifest, tablet, participant)
    except NotAllowed as refused:
        link.send(f"refused {refused.code.value}\n")
        raise
    try:
        attempt = tablet.ledger.begin(manifest["participant"], slot, tablet.now(), log, manifest_sha256)
    except NotAllowed as refused:
        link.send(f"refused {refused.code.value}\n")
        raise
    end, decisions = End.LOG_FAILED, 0
    try:
        facts = describe(manifest, manifest_sha256, controller, tablet.now(), "session")
        facts |= {"attempt": attempt.number} | ({"simulated": True} if tablet.simulated else {})
        sink = LogFile(log, manifest["period_s"], facts)
        session = _live(manifest, controller, link, sink, slot, tablet, attempt)
        end = End.FAULT
        try:
            end = session.run()
        finally:
            decisions = len(session.decisions)
            sink.close()
    finally:
        attempt.end(tablet.now(), end.value, decisions)
    return Outcome(end, session.detail, session)


def _live(
    manifest: Mapping[str, Any], controller: BoundedController, link: Link, sink: LogFile, slot: Slot, tablet: Tablet, attempt: Attempt
) -> LiveSession:
    """Make the loop of an attempt at a slot."""

    def over() -> bool:
        return tablet.now().date().isoformat() > slot.visit_date

    def take_over() -> None:
        try:
            attempt.decide(tablet.now())
        except OSError as error:
            raise LogFailed(f"that the slot is used cannot be noted: {error.strerror}") from error

    return LiveSession(
        controller, _peer(manifest), link, sink.write, 60.0 * slot.minutes, over=over, charge=battery_percent, take_over=take_over
    )


def run_bench(
    manifest: Mapping[str, Any], manifest_sha256: str, controller: BoundedController, link: Link, log: Path | None, seconds: float | None
) -> Outcome:
    """Run a bundle without a participant: no slot, no ledger; lone numbers are taken for beta. Raises LogFailed."""
    facts = describe(manifest, manifest_sha256, controller, datetime.now().astimezone(), "bench")
    sink = None if log is None else LogFile(log, manifest["period_s"], facts)
    session = LiveSession(controller, _peer(manifest), link, sink.write if sink else lambda _row: None, seconds, bare=True)
    try:
        return Outcome(session.run(), session.detail, session)
    finally:
        if sink:
            sink.close()


def describe(
    manifest: Mapping[str, Any], manifest_sha256: str, controller: BoundedController, now: datetime, purpose: str
) -> dict[str, Any]:
    """Describe a log in its head. `purpose`: `session`, `bench` or `replay`; of a replay the time runs as its source says."""
    slot = dict(manifest.get("slot") or {})
    schedule = manifest.get("schedule") or {}
    design = {name: schedule[name] for name in ("design", "level", "seed", "lower_bound") if name in schedule}
    facts = {
        **{name: manifest.get(name) for name in OF_LOG},
        **slot,
        **design,
        "purpose": purpose,
        "manifest_sha256": manifest_sha256,
        "started_at": now.isoformat(timespec="milliseconds"),
        "latency_us": latency(manifest, controller) if purpose != "replay" else None,
        "network_sha256": manifest["files"].get(NETWORK),
    }
    if not is_blinded(manifest):
        return facts
    told = {name: facts[name] for name in OF_BLINDED_LOG if name in facts}
    kept = {name: value for name, value in facts.items() if name not in told}
    return told | {"sealed": seal_facts(kept, os.urandom(16).hex())}


def is_blinded(manifest: Mapping[str, Any]) -> bool:
    """Decide whether people at the tablet must not know what runs."""
    return bool((manifest.get("card") or {}).get("blinded"))


def latency(manifest: Mapping[str, Any], controller: BoundedController, decisions: int = TIMED_DECISIONS) -> dict[str, float]:
    """Measure the time of a whole decision on this machine by the wall clock, in microseconds: `n`, `mean`, `std`, `median`, `p99`.

    Timed in a session of its own, so that the controller stays at the start of its own.
    """
    timed = controller.fresh()
    limits = timed.envelope.limits
    signal, period_s, w = timed.envelope.signal, limits.period_s, limits.window
    level = limits.level_high or manifest.get("normalisation_mean") or 1.0
    betas = np.linspace(0.4, 0.6, 16).tolist()
    taken = []
    for k in range(w + decisions):
        sample = BetaSample(k * period_s, level * betas[k % 16], signal)
        began = time.perf_counter_ns()
        timed.decide(k * period_s, sample)
        if k >= w:
            taken.append((time.perf_counter_ns() - began) / 1000.0)
    values = np.array(taken)
    spread = {"mean": values.mean(), "std": values.std(), "median": np.median(values), "p99": np.quantile(values, 0.99)}
    return {"n": float(decisions)} | {name: round(float(value), 2) for name, value in spread.items()}


def latency_words(measured: Mapping[str, float]) -> str:
    """Describe what `latency` measured, as the paper's table has it: mean and standard deviation in milliseconds."""
    mean, std, median = (measured[name] / 1000.0 for name in ("mean", "std", "median"))
    return f"a decision takes {mean:.3g} ms, SD {std:.3g} ms (median {median:.3g} ms, n = {measured['n']:.0f})"


def battery_percent() -> float | None:
    """Read the charge of the tablet's own battery from its operating system; None where it has none."""
    for source in sorted(POWER.glob("BAT*/capacity")):
        try:
            return float(source.read_text("ascii"))
        except (OSError, ValueError):
            continue  # a battery that reports nothing is as good as none
    return None


def parse_manifest(raw: bytes) -> dict[str, Any]:
    """Parse the manifest as JSON. Raises ValueError where it is no object."""
    manifest = json.loads(raw)
    if not isinstance(manifest, dict):
        raise ValueError("manifest.json must hold one object")
    return manifest


def _peer(manifest: Mapping[str, Any]) -> Peer:
    signal = Signal(manifest["beta_unit"], manifest["beta_source"])
    return Peer(manifest["participant"], manifest.get("hemisphere"), signal, manifest["period_s"])
