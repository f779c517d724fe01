"""`python -m controller [FOLDER] [--run [--log=FILE]]`: check an unpacked bundle against its test vectors, and run it on standard input.

Hashes are checked here; the signature of the manifest is not (that needs a cryptography library): `betaloop control` does.
"""

from __future__ import annotations

import csv
import hashlib
import json
import math
import os
import sys
import time
from collections import deque
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np

from . import decision_log
from .controller import BoundedController
from .envelope import BetaSample, EnvelopeLimits, Signal, reason_names
from .network import MlpNetwork, Output

_LIMITS = ("min_ma", "max_ma", "cdbs_ma", "ramp_ma_per_s", "window", "period_s", "max_beta_age_s")


def main(arguments: list[str]) -> int:
    """Exit code 0: everything agrees; 1: something does not, said on standard error."""
    folder = Path(next((a for a in arguments if not a.startswith("-")), "."))
    try:
        manifest = json.loads((folder / "manifest.json").read_bytes())
        for name, digest in manifest["files"].items():
            if hashlib.sha256((folder / name).read_bytes()).hexdigest() != digest:
                raise ValueError(f"{name} is not the file that the manifest names")
        network = MlpNetwork.from_bytes(
            (folder / "weights.f32").read_bytes(),
            manifest["layers"],
            manifest["normalisation_mean"],
            manifest["normalisation_std"],
            manifest["activations"],
            Output(*(manifest[f"output_{name}"] for name in Output._fields)),
        )
        worst, worst_ma = check(manifest, network, json.loads((folder / "test_vectors.json").read_bytes()))
    except (OSError, ValueError, KeyError) as error:
        sys.stderr.write(f"this bundle cannot be used: {error}\n")
        return 1
    sys.stderr.write(f"test vectors agree: worst difference {worst:.3g} of a fraction, {worst_ma:.3g} mA\n")
    if "--run" in arguments:
        log = next((Path(a.removeprefix("--log=")) for a in arguments if a.startswith("--log=")), None)
        try:
            run(manifest, network, log)
        except BrokenPipeError:
            sys.stderr.write("nobody reads the amplitudes any more\n")
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())  # what is left to write at exit goes nowhere
            return 1
        except OSError as error:
            sys.stderr.write(f"the log {log} cannot be written: {error.strerror}\n")
            return 1
    return 0


def check(manifest: dict[str, Any], network: MlpNetwork, vectors: dict[str, Any]) -> tuple[float, float]:
    """Worst differences of fractions and of decisions (mA) from the test vectors. Raises ValueError where one is too large."""
    worst = float(np.abs(network.act(np.array(vectors["windows"])) - np.array(vectors["expected"])).max())
    controller = _controller(manifest, network)
    worst_ma = 0.0
    for step in vectors["session"]:
        sample = None
        if step["t_s"] is not None:
            beta = math.nan if step["beta"] is None else float(step["beta"])
            sample = BetaSample(step["t_s"], beta, Signal(step["unit"], step["source"]))
        decision = controller.decide(step["now_s"], sample)
        worst_ma = max(worst_ma, abs(decision.amplitude_ma - step["amplitude_ma"]))
        if list(reason_names(decision.reasons)) != step["reasons"]:
            raise ValueError(f"at {step['now_s']} s the reasons are {reason_names(decision.reasons)} instead of {step['reasons']}")
    if not (worst <= vectors["tolerance"] and worst_ma <= vectors["tolerance"] * manifest["cdbs_ma"]):
        raise ValueError(f"the answers differ from the test vectors by {worst:.3g} of a fraction and {worst_ma:.3g} mA")
    return worst, worst_ma


def run(manifest: dict[str, Any], network: MlpNetwork, log: Path | None = None) -> None:
    """One beta amplitude per line in (anything else counts as no number), one amplitude in mA and its reasons per line out.

    With a log, every decision is a row of it too, handed to the operating system at once. Raises OSError where it is there already or
    cannot be written.
    """
    controller, signal = _controller(manifest, network), Signal(manifest["beta_unit"], manifest["beta_source"])
    window: deque[float] = deque(maxlen=manifest["window"])
    with nullcontext() if log is None else log.open("x", newline="", encoding="utf-8") as sink:
        writer = csv.writer(sink) if sink else None
        if sink and writer:
            sink.write(f"{decision_log.kind_line(manifest)}\r\n")
            writer.writerow(decision_log.COLUMNS)
        for k, line in enumerate(sys.stdin):
            try:
                beta = math.nan if "_" in line else float(line)  # float() alone takes "1_5" for 15
            except ValueError:
                beta = math.nan
            now_s = k * manifest["period_s"]
            sample, began = BetaSample(now_s, beta, signal), time.perf_counter_ns()
            decision = controller.decide(now_s, sample)
            latency_us = (time.perf_counter_ns() - began) / 1000.0
            window.append(beta)
            sys.stdout.write(f"{decision.amplitude_ma:.6g} {' '.join(reason_names(decision.reasons))}\n")
            sys.stdout.flush()
            if sink and writer:
                writer.writerow(decision_log.cells(now_s, sample, decision, list(window), latency_us))
                sink.flush()


def _controller(manifest: dict[str, Any], network: MlpNetwork) -> BoundedController:
    limits = EnvelopeLimits(**{name: manifest[name] for name in _LIMITS})
    return BoundedController(network, limits, Signal(manifest["beta_unit"], manifest["beta_source"]))


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
