"""Beta amplitude through the gaps of a real recording, on signals whose amplitude without gaps is known.

    python benchmarks/beta_gaps.py [--repeats N] [--seed N] [--quick]

The gaps are those of the montage recording with packet loss (`BETALOOP_TEST_DATA`, else ../shared/data); the signals are made here: a
beta rhythm of 5 Hz bandwidth whose amplitude waxes and wanes, on a background that falls with frequency, and noise. Each is scored whole,
and with the recording's gaps by two rules: `present` (`ml.signals.band_rows`: predicted for the filter, measured samples scored) and
`former` (every gap-free stretch filtered by itself, short ones left out).

`kept`: share of all rows that a coverage limit keeps; the present rule takes a row that lacks one sample of it.
`error_sd`, `bias`: standard deviation and mean of (beta with gaps - beta without)
over the mean beta, of the rows kept. `error_over_se`: standard deviation of the error over the row's own standard error; 1 if exact.
`most_imputed`: how many imputed betas a state of W = 10 may hold. `usable`: share of steps whose state and next state are then whole, in
sessions of 100 steps whose rows are valid where the recording's are (patterns in random order); `imputed_error`: RMS error of an imputed
beta over the standard deviation of beta in its session; `state_error`: that of all values of the usable states.
`cpu_ratio`: CPU seconds of the present rule over those of the former one.
"""

from __future__ import annotations

import argparse
import json

import numpy as np
from support.gaps import OPTIONS, PERIOD, Rule, gap_patterns, recording, scored

from ml.trajectories import SessionTrajectory

LIMITS = (0.5, 0.6, 0.69, OPTIONS.min_valid_fraction, 0.8)


def imputation(present: Rule, rng: np.random.Generator, sessions: int) -> dict[int, dict[str, float]]:
    """What states gain and lose by so many imputed betas, at the default coverage."""
    out = {}
    parts = [(covered >= OPTIONS.min_valid_fraction - 1e-9, whole, whole + error) for (covered, error, _), whole in present.betas()]
    drawn = [[parts[i] for i in rng.integers(len(parts), size=8)] for _ in range(sessions)]
    for most in (0, 1, 2, 3, 4):
        usable, squares, imputed = [], [], []
        for chosen in drawn:
            valid, whole, seen = (np.concatenate(x)[:110] for x in zip(*chosen, strict=True))
            seen = np.where(valid, seen, np.nan)
            s = SessionTrajectory(1, 1, "other", seen[:10], seen[10:], np.zeros(seen.size - 10), most_imputed=most)
            spread = float(np.std(whole))
            usable.append(s.usable().mean())
            error = (s.padded_beta - whole) / spread
            imputed.append(error[s.imputed] ** 2)
            squares.append(np.lib.stride_tricks.sliding_window_view(error, 10)[:-1][s.usable()].ravel() ** 2)
        errors = np.concatenate(imputed)
        out[most] = {
            "usable": float(np.mean(usable)),
            "imputed_error": float(np.sqrt(errors.mean())) if errors.size else 0.0,
            "state_error": float(np.sqrt(np.concatenate(squares).mean())),
        }
    return out


def main() -> None:
    """Print a table and, as the last line, one JSON object."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=20, help="signals per pattern of gaps")
    parser.add_argument("--seed", type=int, default=0, help="of the signals")
    parser.add_argument("--quick", action="store_true", help="two signals per pattern")
    chosen = parser.parse_args()
    path = recording()
    if path is None:
        return
    rng = np.random.default_rng(chosen.seed)
    present, former, patterns = scored(path, 2 if chosen.quick else chosen.repeats, rng)
    total = sum(rows.shape[1] for rows in present.rows)
    seconds = [(there.sum() / rate, there.size / rate) for rate, there in gap_patterns(path)]
    missing = 1.0 - sum(held for held, _ in seconds) / sum(whole for _, whole in seconds)
    print(f"{total} rows of {PERIOD:g} s, {patterns} patterns of gaps, {100 * missing:.1f} % of samples missing")
    figures = {name: {limit: rule.at(limit) for limit in LIMITS} for name, rule in (("present", present), ("former", former))}
    print(f"{'rule':<9}{'limit':>6}{'kept, %':>9}{'error SD, %':>13}{'bias, %':>9}{'error/SE':>10}")
    for name, by_limit in figures.items():
        for limit, f in by_limit.items():
            over = f"{f['error_over_se']:10.2f}" if "error_over_se" in f else ""
            print(f"{name:<9}{limit:>6.2f}{100 * f['kept']:>9.1f}{100 * f['error_sd']:>13.2f}{100 * f['bias']:>9.2f}{over}")
    states = imputation(present, rng, 40 if chosen.quick else 200)
    print(f"{'most imputed':<13}{'usable, %':>10}{'imputed error, SD':>19}{'state error, SD':>17}")
    for most, s in states.items():
        print(f"{most:<13}{100 * s['usable']:>10.1f}{s['imputed_error']:>19.2f}{s['state_error']:>17.2f}")
    now, before = (figures[name][OPTIONS.min_valid_fraction] for name in ("present", "former"))
    ratios = {
        "kept": now["kept"] / before["kept"],
        "error_sd": now["error_sd"] / before["error_sd"],
        "cpu_ratio": present.cpu_s / former.cpu_s,
    }
    print(json.dumps({"name": "beta_gaps", "figures": figures, "most_imputed": states, "ratios": ratios}))


if __name__ == "__main__":
    main()
