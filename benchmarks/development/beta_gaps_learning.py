"""What gaps in beta, and imputed betas in states, cost a learner: the cohort's sessions with the gaps of a real recording.

    python -m benchmarks.development.beta_gaps_learning [--updates N] [--seeds N] [--sessions N] [--quick]

Each synthetic participant's sessions (four random, one of cDBS, one without DBS, as at a first visit) get the gaps of the montage
recording with packet loss, in patterns drawn per session, and on the rows that stay the errors that such gaps make
(`benchmarks/beta_gaps.py`). On the same sessions policies are trained whole, and with so many imputed betas per state; the same seeds,
updates and gaps in every row.

`usable`: share of the steps that a buffer has. `return over whole`: true expected return of the policies (Monte Carlo, mean over
participants and seeds) minus that of the same learner without gaps, reward units; `SE`: its standard error over participants and seeds.
"""

from __future__ import annotations

import argparse
import json
import time
from dataclasses import replace

import numpy as np

from benchmarks.support.gaps import OPTIONS, Floats, Rule, recording, scored
from benchmarks.support.simulators import WINDOW, CohortWorld
from ml.rl import algorithm, train_many
from ml.trajectories import ReplayBuffer, SessionTrajectory

CODES = ("P1", "P2", "P3", "P4")
MOST_IMPUTED = (0, 1, 2, 3)
ALGORITHM = "td3_bc"


def with_gaps(buffer: ReplayBuffer, rule: Rule, rng: np.random.Generator) -> ReplayBuffer:
    """Sessions whose rows are missing, and off by an error, as those of the recording."""
    parts = [(covered >= OPTIONS.min_valid_fraction - 1e-9, error) for covered, error, _ in rule.rows]

    def spoilt(session: SessionTrajectory) -> SessionTrajectory:
        beta = session.measured_beta
        drawn: list[tuple[Floats, Floats]] = []
        while sum(valid.size for valid, _ in drawn) < beta.size:
            drawn.append(parts[rng.integers(len(parts))])
        valid, error = (np.concatenate(x)[: beta.size] for x in zip(*drawn, strict=True))
        # errors are shares of the mean beta
        seen = np.where(valid.astype(bool), np.maximum(beta + error * np.nanmean(beta), 0.0), np.nan)
        return replace(session, lead_beta=seen[:WINDOW], beta=seen[WINDOW:])

    return replace(buffer, sessions=tuple(spoilt(s) for s in buffer.sessions))


def usable_share(buffer: ReplayBuffer) -> float:
    """Share of all steps that may be learned from."""
    return float(np.concatenate([s.usable() for s in buffer.sessions]).mean())


def returns(world: CohortWorld, buffer: ReplayBuffer, updates: int, seeds: int, sessions: int) -> list[float]:
    """True returns of policies that were trained on a buffer, one per seed."""
    config = algorithm(ALGORITHM).config
    trained = train_many(buffer, [config(updates=updates, seed=k) for k in range(seeds)])
    return [world.truth(t.policy, sessions).total for t in trained]


def main() -> None:
    """Print a table and, as the last line, one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--updates", type=int, default=600, help="gradient steps per policy")
    parser.add_argument("--seeds", type=int, default=2, help="policies per participant and column")
    parser.add_argument("--sessions", type=int, default=60, help="sessions of each true return")
    parser.add_argument("--quick", action="store_true", help="one participant, two seeds, few updates")
    chosen = parser.parse_args()
    if chosen.quick:
        chosen.updates, chosen.seeds, chosen.sessions = 50, 2, 20
    path = recording()
    if path is None:
        return
    began = time.process_time()
    rule, _, _ = scored(path, 2 if chosen.quick else 5, np.random.default_rng(0))
    columns = ("whole", *MOST_IMPUTED)
    shares: dict[str | int, list[float]] = {c: [] for c in columns}
    found: dict[str | int, list[float]] = {c: [] for c in columns}
    codes = CODES[:1] if chosen.quick else CODES
    for number, code in enumerate(codes):
        world = CohortWorld(code)
        whole = world.data(number, 1)
        holed = with_gaps(whole, rule, np.random.default_rng([7, number]))
        for column in columns:
            sessions = whole.sessions if column == "whole" else tuple(replace(s, most_imputed=int(column)) for s in holed.sessions)
            buffer = replace(whole, sessions=sessions)
            shares[column].append(usable_share(buffer))
            found[column] += returns(world, buffer, chosen.updates, chosen.seeds, chosen.sessions)
    base = np.array(found["whole"])
    cpu_s = time.process_time() - began
    print(f"{ALGORITHM}, {chosen.updates} updates, {len(codes)} participants with {chosen.seeds} seeds each; {cpu_s:.0f} s of CPU")
    print(f"{'states':<22}{'usable, %':>10}{'return over whole':>19}{'SE':>7}")
    figures = {}
    for column in columns:
        gain = np.array(found[column]) - base
        error = float(gain.std(ddof=1) / np.sqrt(gain.size))
        figures[str(column)] = {"usable": float(np.mean(shares[column])), "gain": float(gain.mean()), "standard_error": error}
        name = "no gaps" if column == "whole" else f"at most {column} imputed"
        print(f"{name:<22}{100 * np.mean(shares[column]):>10.1f}{gain.mean():>19.2f}{error:>7.2f}")
    print(json.dumps({"name": "beta_gaps_learning", "returns": {str(c): found[c] for c in columns}, "figures": figures}))


if __name__ == "__main__":
    main()
