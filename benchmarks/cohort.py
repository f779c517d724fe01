"""Speed of the synthetic cohort and its ground truth. Prints a table; the last line is one JSON object.

python benchmarks/cohort.py            about a minute on one core
python benchmarks/cohort.py --full     six policies x 200 sessions x 10 minutes on all cores, too
"""

from __future__ import annotations

import argparse
import json
import os
import time

import numpy as np

from ml.policies.policy import ConstantPolicy, ProportionalPolicy
from ml.population import PARTICIPANTS, run_session, run_sessions, true_return

SETTLE_AND_LEAD_S = 2.0 * (5 + 10)


def simulated_per_cpu_s(code: str, sessions: int = 8, steps: int = 300, keep_lfp: bool = False) -> float:
    """Simulated seconds per CPU second, on one thread."""
    started = time.process_time()
    run_sessions(code, "random", seeds=np.arange(sessions), study_seed=np.arange(sessions), steps=steps, keep_lfp=keep_lfp)
    return sessions * (2.0 * steps + SETTLE_AND_LEAD_S) / (time.process_time() - started)


def ground_truth_s(code: str, sessions: int, threads: int) -> float:
    """Wall seconds for the true returns of six policies over sessions of 10 minutes."""
    participant = PARTICIPANTS[code]
    settings = participant.mdp_settings()
    xi = settings.xi_beta
    policies = [ConstantPolicy(a) for a in (0.4, 0.7, 1.0)] + [
        ProportionalPolicy(0.7 * xi, xi, floor=f, newest=10) for f in (0.2, 0.4, 0.6)
    ]
    started = time.perf_counter()
    for policy in policies:
        true_return(policy, participant, settings, sessions=sessions, threads=threads)
    return time.perf_counter() - started


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0] if __doc__ else None)
    parser.add_argument("--quick", action="store_true", help="without the six policies; the default")
    parser.add_argument("--full", action="store_true", help="also time six policies x 200 sessions x 10 minutes")
    arguments = parser.parse_args()
    run_session("P1", "random", seed=0, steps=2)  # compile
    speeds = {code: simulated_per_cpu_s(code) for code in PARTICIPANTS}
    with_lfp = simulated_per_cpu_s("P1", keep_lfp=True)
    print(f"{'participant':<14}{'simulated s per CPU s':>24}")
    for code, speed in speeds.items():
        print(f"{code:<14}{speed:>24,.0f}")
    print(f"{'P1, LFP kept':<14}{with_lfp:>24,.0f}")
    figures = {"simulated_s_per_cpu_s": round(min(speeds.values())), "simulated_s_per_cpu_s_with_lfp": round(with_lfp)}
    if arguments.full:
        threads = min(2, os.cpu_count() or 1)
        figures["six_policies_200_sessions_wall_s"] = round(ground_truth_s("P1", 200, threads))
        print(f"six policies x 200 sessions x 10 min on {threads} threads: {figures['six_policies_200_sessions_wall_s']} s")
    required = 2000.0
    ratios = {"simulated_s_per_cpu_s_to_required": round(min(speeds.values()) / required, 2)}
    print(json.dumps({"name": "cohort", "figures": figures, "ratios": ratios, "baseline": {"required_simulated_s_per_cpu_s": required}}))


if __name__ == "__main__":
    main()
