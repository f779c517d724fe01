"""`betaloop control`: a bundle at work on a stream of beta amplitudes, every decision logged. No database, no service."""

from __future__ import annotations

import io
import math
import re
import sys
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from pathlib import Path
from typing import Any

import numpy as np
from cryptography.hazmat.primitives.asymmetric.ed25519 import Ed25519PrivateKey, Ed25519PublicKey

from app.platform.errors import Invalid
from app.settings import get_settings
from app.tablet.battery import read_implant
from app.tablet.live import is_live, run_live
from app.tablet.sources import Rows, Source, Task, Wish, open_source
from ml.deploy.appraisal import battery_gain
from ml.deploy.bundle import OpenBundle, open_bundle
from ml.deploy.manifest import BundleError, BundleManifest
from ml.deploy.runtime.control_loop import End, LiveSession
from ml.deploy.runtime.decision_log import LogFailed, LogFile, Row
from ml.deploy.runtime.envelope import OF_THE_CONTROLLER, Decision, Reason, Signal, reason_names
from ml.deploy.runtime.session import describe, is_blinded, latency, latency_words
from ml.deploy.wording import battery_words, warning_sentences
from ml.energy import Implant, relative_energy, saving_percent

_KEY = "bundle-signing"
_TELLING = frozenset({
    "latency_us", "worst_late_ms", "mean_amplitude_ma", "energy_of_cdbs", "energy_saved_percent", "battery", "battery_life_of_cdbs",
    "battery_life", "battery_days", "battery_life_on_cdbs", "battery_days_on_cdbs",
})  # fmt: skip
"""Entries of a summary that reveal which controller a blinded session ran."""


Sink = Callable[[Row], None]
"""What a log is written to."""


@dataclass
class Run:
    """Results of a session of the controller; they grow with every decision."""

    period_s: float
    cdbs_ma: float
    decisions: list[Decision] = field(default_factory=list)
    latency_us: list[float] = field(default_factory=list)
    signal_us: list[float] = field(default_factory=list)
    signals: set[Signal] = field(default_factory=set)
    missed: int = 0
    worst_late_ms: float = 0.0

    @staticmethod
    def of(session: LiveSession) -> Run:
        """Collect the results of a session with a device side."""
        limits = session.controller.envelope.limits
        run = Run(limits.period_s, limits.cdbs_ma, session.decisions, [row.latency_us for row in session.rows], missed=session.missed)
        run.signal_us = [0.0] * len(run.decisions)
        run.signals = {row.sample.signal for row in session.rows if row.sample is not None}
        run.worst_late_ms = 1000.0 * max((row.late_s for row in session.rows), default=0.0)
        return run

    def summary(self, source: Source) -> dict[str, Any]:
        """Compute the numbers of the session by name; None where there is nothing to count."""
        amplitudes = np.array([d.amplitude_ma for d in self.decisions])
        latency = np.array(self.latency_us)
        asked = [d for d in self.decisions if not d.fallback]
        energy = relative_energy(amplitudes / self.cdbs_ma) if amplitudes.size else math.nan
        body: dict[str, Any] = {
            "source": source.description,
            "decisions": len(self.decisions),
            "policy": len(asked),
            "fallbacks": len(self.decisions) - len(asked),
            "reasons": dict(Counter(name for d in self.decisions for name in reason_names(d.reasons))),
            "deadline_misses": self.missed,
            "worst_late_ms": round(self.worst_late_ms, 3),
            "latency_us": _spread(latency),
            "signal_us": _spread(np.array(self.signal_us)) if any(self.signal_us) else None,
            "mean_amplitude_ma": float(amplitudes.mean()) if amplitudes.size else None,
            "energy_of_cdbs": None if math.isnan(energy) else energy,
            "energy_saved_percent": None if math.isnan(energy) else saving_percent(energy, 1.0),
        }
        return body | _agreement(source)


def control(bundle: Path, source: str | None, wish: Wish, task: Task) -> dict[str, Any]:
    """Verify a bundle and, with a source, run its controller. Returns the summary.

    Args:
        bundle: the ZIP. source: for the signed plan's session, a device side (`-` in real time, `tcp:PORT`, `tail:FILE`,
            `simulated:P1:SEED`); else one that `open_source` knows. Without a source the bundle is only verified.
        wish: as `open_source` takes it. task: what else is to be done.

    Raises:
        Invalid: the bundle is not what it should be, may not run now, or an argument makes no sense. NotFound: no such source.
    """
    implant = None if task.battery is None else read_implant(task.battery)
    opened = verified(bundle, task.key)
    manifest = opened.manifest
    if task.participant is not None and task.participant != manifest.participant:
        raise Invalid(
            f"{bundle.name} is of participant {manifest.participant}, not {task.participant}.", "A bundle is for its participant alone."
        )
    facts: dict[str, Any] = {"bundle": bundle.name, "participant": manifest.participant, "policy_name": manifest.policy_name}
    facts |= {"policy_id": manifest.policy_id, "approved": bool(manifest.approvals), "warnings": warning_sentences(manifest)}
    if manifest.card is not None and manifest.card.blinded:  # the tablet does not show what runs
        facts |= {"policy_name": manifest.card.head, "policy_id": None, "blinded": True, "warnings": []}
    if task.timed and not is_blinded(opened.manifest_json):  # which would reveal the network's size
        facts["measured_us"] = latency(opened.manifest_json, opened.controller(), task.timed)
    if source is None:
        # the number of files distinguishes a network from a schedule
        return facts | {"verified": True, "files": None if facts.get("blinded") else len(manifest.files)}
    if isinstance(sys.stdin, io.TextIOWrapper):
        sys.stdin.reconfigure(errors="replace")  # bytes that are no text are no number either, and no reason to stop
    if is_live(source, wish):
        outcome, where = run_live(opened, bundle.name, source, task)
        run, stream = Run.of(outcome.session), Source(_no_rows(), where)
        facts["ended"] = outcome.end.value + (f" ({outcome.detail})" if outcome.detail else "")
        facts["failed"] = outcome.end not in (End.COMPLETE, End.STOPPED)
    else:
        run, stream = Run(manifest.period_s, manifest.cdbs_ma), open_source(source, manifest, wish, sys.stdin)
        if stream.participant not in (None, manifest.participant):
            facts["warnings"].append(
                f"The bundle is of participant {manifest.participant}, the source is synthetic participant {stream.participant}."
            )
        facts |= _replayed(opened, stream, run, wish, task)
    found = facts | run.summary(stream) | _battery(run, implant) | _foreign(run, manifest)
    return _masked(found) if facts.get("blinded") else found


def _no_rows() -> Rows:
    """Yield no rows: the source was read to its end already."""
    yield from ()


def _replayed(opened: OpenBundle, stream: Source, run: Run, wish: Wish, task: Task) -> dict[str, Any]:
    """Drive the controller from recorded or simulated data; no person is stimulated."""
    log = None
    try:
        if task.log is not None:
            about = describe(opened.manifest_json, opened.manifest_sha256, opened.controller(), datetime.now().astimezone(), "replay")
            log = LogFile(task.log, run.period_s, about)
        drive(opened, stream, run, wish.realtime, log.write if log else None)
    except KeyboardInterrupt:  # ended by hand: what was done so far is summed up
        return {"ended": "by hand"}
    except LogFailed as error:
        done = f" The run ended after {len(run.decisions) - 1} decisions." if log else ""
        raise Invalid(
            f"{str(error)[0].upper()}{str(error)[1:]}.{done}", "Name a new file on a disk with free space, in a folder that may be written."
        ) from error
    finally:
        if log is not None:
            log.close()
    return {}


def verified(path: Path, key: str | None) -> OpenBundle:
    """Open a bundle and check its signature, hashes and test vectors.

    Args:
        path: of the ZIP. key: public key as 64 hexadecimal digits, or a file with them; the one of this installation when None.

    Raises:
        Invalid: no key, or a bundle that is not as it should be.
    """
    try:
        return open_bundle(path.read_bytes(), _public_key(key))
    except BundleError as error:
        raise Invalid(f"{path.name} must not be used: {error}.", "Take the bundle from the study again.") from error
    except OSError as error:
        raise Invalid(f"{path} cannot be read: {error.strerror}.", "Name the ZIP that the study gave you.") from error


def drive(
    opened: OpenBundle, source: Source, run: Run, realtime: bool, sink: Sink | None, wait: Callable[[float], None] = time.sleep
) -> None:
    """Run the loop to the end of the source, one decision per row.

    Args:
        opened: the bundle. source: what comes. run: is filled in.
        realtime: wait until each row is due, and decide by the clock, so that a decision which comes a period late finds its beta stale.
        sink: gets the log, row by row, so that a crash loses none. wait: sleeps for so many seconds.
    """
    controller = opened.controller()
    rows = source.rows
    row = next(rows, None)
    began_s = time.perf_counter() - (row.now_s if row else 0.0)
    while row is not None:
        due = began_s + row.now_s
        if realtime and (pause := due - time.perf_counter()) > 0:
            wait(pause)
        now_s = max(row.now_s, time.perf_counter() - began_s) if realtime else row.now_s
        start = time.perf_counter_ns()
        decision = controller.decide(now_s, row.sample)
        latency_us = (time.perf_counter_ns() - start) / 1000.0
        # A decision is late when it is not there within one period of the end of the window it is about.
        late_s = (max(0.0, time.perf_counter() - due) if realtime else latency_us / 1e6) + row.signal_us / 1e6
        missed = late_s > run.period_s
        run.decisions.append(decision)
        if row.sample is not None:
            run.signals.add(row.sample.signal)
        run.latency_us.append(latency_us)
        run.signal_us.append(row.signal_us)
        run.missed += missed
        if missed:
            sys.stderr.write(f"deadline missed: the decision of {row.now_s:.3f} s came {1000.0 * late_s:.0f} ms after its window's end\n")
        run.worst_late_ms = max(run.worst_late_ms, 1000.0 * late_s)
        if sink:
            drawn = None if decision.fallback else controller.drawn()
            sink(Row(row.now_s, row.sample, decision, list(controller.window), latency_us, row.signal_us, late_s, missed, drawn))
        try:
            row = rows.send(decision.amplitude_ma)
        except StopIteration:
            row = None


def _masked(summary: dict[str, Any]) -> dict[str, Any]:
    """Remove the entries of a blinded session's summary that reveal its controller."""
    telling = reason_names(OF_THE_CONTROLLER)
    kept = {name: None if name in _TELLING else value for name, value in summary.items()}
    return kept | {"reasons": {name: count for name, count in summary["reasons"].items() if name not in telling}}


def lines(summary: dict[str, Any]) -> str:
    """Format the summary for a person."""
    use = "approved" if summary["approved"] else "NOT APPROVED: not to be used on a participant"
    who = f"participant {summary['participant']}, {_what(summary)}, {use}"
    warned = [f"warning          {text}" for text in summary["warnings"]]
    if summary.get("verified"):
        files = "files" if summary["files"] is None else f"{summary['files']} files"
        said = f"{summary['bundle']}: signature, {files} and test vectors are right. {who}."
        return "\n".join([said, *warned, *_measured(summary)])
    latency = summary["latency_us"]
    reasons = ", ".join(f"{name} {count}" for name, count in summary["reasons"].items()) or "none"
    out = [
        f"bundle           {who}",
        *warned,
        f"source           {summary['source']}",
        f"decisions        {summary['decisions']}: {summary['fallbacks']} on cDBS as fall-back",
        f"reasons          {reasons}",
        *([f"ended            {summary['ended']}"] if "ended" in summary else []),
        *_measured(summary),
        f"deadline misses  {summary['deadline_misses']}"
        + ("" if summary["worst_late_ms"] is None else f" (worst {summary['worst_late_ms']:.3g} ms after the window's end)"),
    ]
    for name, spread in (("decision", latency), ("P_beta", summary["signal_us"])):
        if spread:
            spread_text = f"mean {spread['mean']:.1f}, std {spread['std']:.1f}, median {spread['median']:.1f}, 99 % {spread['p99']:.1f}"
            out.append(f"{name + ' in us':<17}{spread_text}")
    if summary["mean_amplitude_ma"] is not None:
        out.append(f"mean amplitude   {summary['mean_amplitude_ma']:.3f} mA")
        out.append(f"energy           {summary['energy_of_cdbs']:.3f} of cDBS: {summary['energy_saved_percent']:.1f} % saved")
    if summary.get("battery"):
        out.append(f"battery          {summary['battery']}")
    if summary.get("battery_life"):
        out += [f"battery life     {summary['battery_life']}", f"  on cDBS        {summary['battery_life_on_cdbs']}"]
    if "streaming_correlation" in summary:
        out.append(
            f"P_beta in time   correlation with afterwards {summary['streaming_correlation']:.5f}, mean difference "
            f"{summary['streaming_mean_percent']:.2f} %, worst {summary['streaming_worst_percent']:.2f} % (n = {summary['streaming_n']})"
        )
    if "wrong_signal" in summary:
        out.append(f"NO DECISION BY THE POLICY: {summary['wrong_signal']}")
    return "\n".join(out)


def _what(summary: dict[str, Any]) -> str:
    name, number = summary["policy_name"], summary["policy_id"]
    if summary.get("blinded"):
        return f"session {name}, blinded"
    return f"schedule {name}" if number is None else f"policy {name} (no. {number})"


def _measured(summary: dict[str, Any]) -> list[str]:
    """Format the latencies that `--time` measured, as lines of the summary."""
    found = summary.get("measured_us")
    if not found:
        return []
    return [f"on this machine  {latency_words(found)}"]


def _public_key(key: str | None) -> Ed25519PublicKey:
    if key is None:
        path = get_settings().data_dir / "secrets" / _KEY
        if not path.exists():
            raise Invalid(
                "This machine does not know the key that bundles are signed with.", "Give it with --key: GET /api/v1/bundle-key gives it."
            )
        return Ed25519PrivateKey.from_private_bytes(get_settings().secret(_KEY)).public_key()
    text = key.strip()
    if not re.fullmatch(r"[0-9a-fA-F]{64}", text):
        try:
            text = Path(key).read_text("utf-8").strip()
        except (OSError, UnicodeDecodeError, ValueError) as error:
            raise Invalid(f"The key '{key[:80]}' is neither 64 hexadecimal digits nor a readable file.", "Give one of them.") from error
    try:
        return Ed25519PublicKey.from_public_bytes(bytes.fromhex(text))
    except ValueError as error:
        raise Invalid("The key is not 64 hexadecimal digits.", "GET /api/v1/bundle-key gives it.") from error


def _spread(values: Any) -> dict[str, float] | None:
    if len(values) == 0:
        return None
    return {
        "mean": float(np.mean(values)),
        "std": float(np.std(values)),
        "median": float(np.median(values)),
        "p99": float(np.quantile(values, 0.99)),
    }


def _foreign(run: Run, manifest: BundleManifest) -> dict[str, Any]:
    """Warn if every beta amplitude received had another unit or source than the bundle's."""
    came = [d for d in run.decisions if not d.reasons & (Reason.NO_BETA | Reason.STALE_BETA)]
    if not came or not all(d.reasons & Reason.WRONG_SIGNAL for d in came):
        return {}
    given = ", ".join(sorted(f"{unit} from {source}" for unit, source in run.signals))
    return {"wrong_signal": f"the bundle takes beta in {manifest.beta_unit} from {manifest.beta_source}; the source gives {given}"}


def _battery(run: Run, implant: Implant | None) -> dict[str, Any]:
    """Estimate what the session's amplitudes mean for a battery; empty if there were no decisions."""
    fractions = np.array([d.amplitude_ma for d in run.decisions]) / run.cdbs_ma
    if not fractions.size:
        return {}
    energy, charge = float(np.mean(fractions**2)), float(fractions.mean())
    gain = battery_gain(energy, charge)
    facts: dict[str, Any] = {"battery": battery_words(energy, charge), "battery_life_of_cdbs": [gain.low, gain.high]}
    if implant is None:
        return facts
    life, cdbs = implant.life(fractions * run.cdbs_ma), implant.life([run.cdbs_ma])
    facts |= {"battery_life": str(life), "battery_days": [life.days.low, life.days.high]}
    return facts | {"battery_life_on_cdbs": str(cdbs), "battery_days_on_cdbs": [cdbs.days.low, cdbs.days.high]}


def _agreement(source: Source) -> dict[str, Any]:
    """Compare the streamed P_beta with P_beta computed afterwards, over the periods valid in both; empty for fewer than 3."""
    streamed = np.array(source.streamed)
    offline = source.offline[: streamed.size]
    both = np.isfinite(streamed[: offline.size]) & np.isfinite(offline)
    if both.sum() < 3:
        return {}
    now, later = streamed[: offline.size][both], offline[both]
    difference = 100.0 * np.abs(now - later) / later
    return {
        "streaming_n": int(both.sum()),
        "streaming_only_later": int(np.sum(np.isfinite(offline) & ~both)),
        "streaming_correlation": float(np.corrcoef(now, later)[0, 1]),
        "streaming_mean_percent": float(difference.mean()),
        "streaming_worst_percent": float(difference.max()),
    }
