"""The paper's two tables of the deployed controller: how long one decision takes, and what it saves of energy and battery.

    python benchmarks/deploy.py [--quick] [--passes N] [--json]     microseconds per decision, one thread, batch 1
    python benchmarks/deploy.py --energy                            closed loop on the synthetic participants; about two minutes

Full (400x300) and distilled (20x10) policies, by torch, onnxruntime, the numpy network and the whole Python controller (window update and
safety envelope with it), and the C header (-O3; a whole decision too; float32 and whole numbers). `wall` is the time that passed, with the
slices in which the machine did something else; `CPU` is the thread's own time. The timer's own cost, measured the same way, is printed
first and not taken off. C is timed inside C over blocks of 1000 decisions, since one is shorter than the timer's steps.

`--energy` trains one full policy per synthetic participant on three visits (ReBRAC, 5000 updates), distils it, and runs both as bundles,
within the safety envelope and in closed loop, next to the random controller. Battery life is a multiple of that under cDBS, under the
assumption that `ml.deploy.appraisal` states: the paper measured the runtime of tablet and link instead.
"""

from __future__ import annotations

import argparse
import io
import json
import shutil
import subprocess
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from support.results import run_benchmark

from ml.deploy.appraisal import battery_gain
from ml.deploy.bundle import build_bundle, open_bundle
from ml.deploy.manifest import BundleManifest
from ml.deploy.runtime.envelope import BetaSample, Signal
from ml.policies.onnx_policy import OnnxPolicy
from ml.population import PARTICIPANTS, random_controller_buffer
from ml.population.env import ParticipantEnv
from ml.rl import ALGORITHMS, STUDENT_HIDDEN, TEACHER_HIDDEN, DistilConfig, MlpPolicy, distil, train
from ml.trajectories import ReplayBuffer

WINDOW, MEAN, STD = 10, 120.0, 35.0
WARM_UP, BLOCK = 200, 1000
SESSIONS, SESSION_STEPS = 10, 300
PAPER = {"full": "4780 mean, 32260 std (Surface Go)", "distilled": "2980 mean, 1720 std (Surface Go)"}
TIMER = r"""
#define _POSIX_C_SOURCE 199309L
#include <stdio.h>
#include <time.h>
#include HEADER
static double now_us(clockid_t clock) {
    struct timespec t;
    clock_gettime(clock, &t);
    return 1e6 * (double)t.tv_sec + 1e-3 * (double)t.tv_nsec;
}
int main(void) {
    betaloop_state s;
    long i, block;
    int64_t now = 0;
    volatile float sink = 0.0f;
    betaloop_start(&s);
    for (block = 0; block < BLOCKS; ++block) {
        double wall = now_us(CLOCK_MONOTONIC), cpu = now_us(CLOCK_THREAD_CPUTIME_ID);
        for (i = 0; i < REPEATS; ++i, now += BETALOOP_PERIOD_MS) {
            betaloop_sample b = {0, 0.0f, BETALOOP_UNIT, BETALOOP_SOURCE};
            b.t_ms = now;
            b.beta = 90.0f + (float)(now % 67);
            sink += betaloop_decide(&s, now, &b).amplitude_ma;
        }
        cpu = now_us(CLOCK_THREAD_CPUTIME_ID) - cpu;
        wall = now_us(CLOCK_MONOTONIC) - wall;
        printf("%.6f %.6f\n", wall / REPEATS, cpu / REPEATS);
    }
    return sink < 0.0f;
}
"""


def timed(work: Callable[[int], Any], passes: int) -> tuple[Any, Any]:
    """Measure wall and CPU time of each pass, microseconds, both [passes]."""
    for i in range(WARM_UP):
        work(i)
    wall, cpu = np.empty(passes), np.empty(passes)
    for i in range(passes):
        c, w = time.thread_time_ns(), time.perf_counter_ns()
        work(WARM_UP + i)
        wall[i] = (time.perf_counter_ns() - w) / 1000
        cpu[i] = (time.thread_time_ns() - c) / 1000
    return wall, cpu


def timed_c(folder: Path, header: str, full: bool, blocks: int) -> tuple[Any, Any]:
    """Measure the C header's decisions, means over blocks, microseconds."""
    (folder / "timer.c").write_text(TIMER)
    options = [f'-DHEADER="{header}"', f"-DBLOCKS={blocks}", f"-DREPEATS={20 if full else BLOCK}"]
    subprocess.run(["cc", "-std=c99", "-O3", *options, "timer.c", "-o", "timer"], cwd=folder, check=True)
    out = subprocess.run([folder / "timer"], capture_output=True, text=True, check=True).stdout
    rows = np.array([[float(x) for x in line.split()] for line in out.splitlines()])
    return rows[:, 0], rows[:, 1]


def measure(name: str, hidden: tuple[int, ...], passes: int) -> dict[str, tuple[Any, Any]]:
    """Measure every runtime of one policy."""
    policy = MlpPolicy(WINDOW, hidden, mean=MEAN, std=STD, seed=1)
    manifest = BundleManifest(
        participant="bench", policy_id=1, policy_name=name, window=WINDOW, beta_unit="uV", beta_source="time_domain", min_ma=0.0,
        max_ma=3.0, cdbs_ma=3.0, ramp_ma_per_s=1.5, code_version="bench",
    )  # fmt: skip
    windows = np.abs(np.random.default_rng(0).normal(MEAN, STD, (256, WINDOW)))
    bundle = build_bundle(policy.to_onnx(), manifest, windows[:8])
    opened, onnx = open_bundle(bundle), OnnxPolicy(policy.to_onnx(), WINDOW)
    rows = [windows[i : i + 1] for i in range(256)]
    signal, controller = Signal("uV", "time_domain"), opened.controller()
    betas = windows.ravel().tolist()

    def step(i: int) -> None:
        opened.network.push(betas[i % len(betas)])
        opened.network.fraction()

    out = {
        "torch": timed(lambda i: policy.act(rows[i % 256]), passes),
        "onnxruntime": timed(lambda i: onnx.act(rows[i % 256]), passes),
        "numpy, window update and network": timed(step, passes),
        "numpy, whole decision": timed(lambda i: controller.decide(2.0 * i, BetaSample(2.0 * i, betas[i % len(betas)], signal)), passes),
    }
    if shutil.which("cc"):
        with tempfile.TemporaryDirectory() as scratch:
            with zipfile.ZipFile(io.BytesIO(bundle)) as archive:
                archive.extractall(scratch)
            folder = Path(scratch)
            out["C float32, whole decision"] = timed_c(folder, "betaloop_controller.h", name == "full", max(passes // 5, 200))
            if (folder / "betaloop_controller_int8.h").exists():
                out["C whole numbers, whole decision"] = timed_c(folder, "betaloop_controller_int8.h", False, max(passes // 5, 200))
    return out


def energies(codes: Iterable[str], updates: int) -> list[dict[str, Any]]:
    """Compute mean squared and mean amplitude over cDBS of each participant's controllers, [sessions of SESSION_STEPS], and battery
    life."""
    out = []
    for code in codes:
        buffer = random_controller_buffer(code, visits=3, sessions_per_visit=6, steps=SESSION_STEPS, seed=2026)
        learner = ALGORITHMS["rebrac"]
        config = learner.config(
            updates=updates, batch=64, actor_lr=3e-4, actor_penalty=0.1, aim="return", record_every=updates // 10, seed=0
        )
        full = train(buffer, config).policy
        small = distil(full, buffer, DistilConfig()).policy
        lowest, rng = buffer.settings.bound, np.random.default_rng(5)
        rows = {
            "full": closed_loop(code, full, buffer),
            "distilled": closed_loop(code, small, buffer),
            "random": [rng.uniform(lowest, 1.0, SESSION_STEPS) for _ in range(SESSIONS)],
        }
        for name, sessions in rows.items():
            energy = np.array([np.mean(a**2) for a in sessions])
            gain = battery_gain(float(energy.mean()), float(np.mean(sessions)))
            saved = 100.0 * (1.0 - energy)
            out.append({"participant": code, "controller": name, "saved_percent": saved.mean(), "saved_sd": saved.std(ddof=1),
                        "mean_amplitude": float(np.mean(sessions)), "battery_low": gain.low, "battery_high": gain.high})  # fmt: skip
    return out


def closed_loop(code: str, policy: MlpPolicy, buffer: ReplayBuffer) -> list[Any]:
    """Compute the amplitude over cDBS per step of each session, as the bundle's controller decides within its limits, [SESSION_STEPS]
    each."""
    window = buffer.settings.window
    manifest = BundleManifest(
        participant=code, policy_id=1, policy_name="bench", window=window, beta_unit="uV", beta_source="time_domain", min_ma=0.0,
        max_ma=3.0, cdbs_ma=3.0, ramp_ma_per_s=1.5, code_version="bench",
    )  # fmt: skip
    opened = open_bundle(build_bundle(policy.to_onnx(), manifest, buffer.transitions().states[:8]))
    signal = Signal(manifest.beta_unit, manifest.beta_source)
    sessions = []
    for seed in range(SESSIONS):
        controller = opened.controller()
        environment = ParticipantEnv(code, SESSION_STEPS, buffer.settings)
        before, _ = environment.reset(seed=seed)
        for i, beta in enumerate(before.tolist()):
            now = 2.0 * (i - window + 1)
            decision = controller.decide(now, BetaSample(now, beta, signal))
        amplitudes = np.empty(SESSION_STEPS)
        for k in range(SESSION_STEPS):
            amplitudes[k] = decision.amplitude_ma / manifest.cdbs_ma
            info = environment.step(np.array([amplitudes[k]], dtype=np.float32))[-1]
            decision = controller.decide(2.0 * (k + 1), BetaSample(2.0 * (k + 1), float(info["beta"]), signal))
        sessions.append(amplitudes)
    return sessions


def figures(values: Any) -> dict[str, float]:
    """Compute mean, standard deviation, median and 99th percentile."""
    return {"mean": values.mean(), "std": values.std(), "median": np.median(values), "p99": np.quantile(values, 0.99)}


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="200 passes; with --energy one participant, 200 updates")
    parser.add_argument("--passes", type=int, default=2000, help="timed passes, at least 200 as in the paper")
    parser.add_argument("--energy", action="store_true", help="energy and battery instead of computation time")
    parser.add_argument("--json", action="store_true")
    given = parser.parse_args()
    torch.set_num_threads(1)
    if given.energy:
        codes = list(PARTICIPANTS)
        found = energies(codes[:1] if given.quick else codes, 200 if given.quick else 5000)
        if given.json:
            print(json.dumps(found, indent=1))
            return
        print(f"{'participant':<13}{'controller':<12}{'mean amplitude':>15}{'energy saved %':>16}{'sd':>6}{'battery, times cDBS':>21}")
        for row in found:
            life = f"{row['battery_low']:.2f} to {row['battery_high']:.2f}"
            print(
                f"{row['participant']:<13}{row['controller']:<12}{row['mean_amplitude']:>15.2f}{row['saved_percent']:>16.1f}"
                f"{row['saved_sd']:>6.1f}{life:>21}"
            )
        return
    passes = 200 if given.quick else max(given.passes, 200)
    rows = [("timer alone", "", *timed(lambda i: None, passes))]
    for name, hidden in (("full", TEACHER_HIDDEN), ("distilled", STUDENT_HIDDEN)):
        rows += [(name, runtime, wall, cpu) for runtime, (wall, cpu) in measure(name, hidden, passes).items()]
    if given.json:
        print(json.dumps([{"policy": p, "runtime": r, "wall_us": figures(w), "cpu_us": figures(c)} for p, r, w, c in rows], indent=1))
        return
    print(f"{'policy':<12}{'runtime':<36}{'wall: mean':>11}{'std':>9}{'median':>9}{'p99':>9}{'CPU: mean':>12}{'std':>9}{'median':>9}")
    for policy, runtime, wall, cpu in rows:
        w, c = figures(wall), figures(cpu)
        print(
            f"{policy:<12}{runtime:<36}{w['mean']:>11.3f}{w['std']:>9.2f}{w['median']:>9.3f}{w['p99']:>9.2f}"
            f"{c['mean']:>12.3f}{c['std']:>9.2f}{c['median']:>9.3f}"
        )
    for name, text in PAPER.items():
        print(f"{name:<12}the paper, network alone: {text}")


if __name__ == "__main__":
    run_benchmark(main)
