"""The log of a controller: a kind line that says what ran, a header, and one row per decision.

The row of a decision holds the beta amplitude of the period that ended at `due_s`, and the amplitude decided for the time from `t_s` to the
next decision's: beta and amplitude of one row are those of two steps. Readers know it by its first line.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from .envelope import BetaSample, Decision, reason_names

VERSION = 2
NETWORK = "model.onnx"
"""The file of a bundle by which a policy is known, in whatever installation."""
COLUMNS = (
    "t_s", "due_s", "beta", "unit", "source", "valid", "window", "fraction", "requested_ma", "amplitude_ma", "action", "reasons",
    "latency_us", "signal_us", "late_ms", "missed", "detail",
)  # fmt: skip


def kind_line(manifest: Mapping[str, Any]) -> str:
    """The first line of a log, without its end: which policy decided, for which side, and within which limits."""
    m = manifest
    side = f", side {m['hemisphere']}" if m.get("hemisphere") else ""
    return (
        f"# betaloop controller log, version {VERSION}, period {m['period_s']:g} s, policy {m['policy_id']}, network {m['files'][NETWORK]}"
        f"{side}, limits {m['min_ma']:.9g} to {m['max_ma']:.9g} mA, cDBS {m['cdbs_ma']:.9g} mA, ramp {m['ramp_ma_per_s']:.9g} mA/s"
    )


def cells(
    due_s: float,
    sample: BetaSample | None,
    decision: Decision,
    window: list[float],
    latency_us: float,
    signal_us: float = 0.0,
    late_s: float = 0.0,
    missed: bool = False,
) -> list[Any]:
    """The row of a decision, in the order of `COLUMNS`.

    Args:
        due_s: end of the period whose beta amplitude came, seconds from the session's start. sample: that beta amplitude, if one came.
        decision: what was decided. window: beta amplitudes so far, the newest last.
        latency_us, signal_us: time that the decision, and P_beta before it, took. late_s, missed: after the period's end, and too late.
    """
    shown = window[len(window) - decision.valid :] if decision.valid else []
    return [
        f"{decision.t_s:.3f}",
        f"{due_s:.3f}",
        "" if sample is None else f"{sample.beta:.9g}",
        "" if sample is None else sample.signal.unit,
        "" if sample is None else sample.signal.source,
        decision.valid,
        " ".join(f"{beta:.6g}" for beta in shown),
        "" if decision.fraction is None else f"{decision.fraction:.7g}",
        "" if decision.requested_ma is None else f"{decision.requested_ma:.6g}",
        f"{decision.amplitude_ma:.9g}",
        "cdbs" if decision.fallback else "policy",
        " ".join(reason_names(decision.reasons)),
        f"{latency_us:.1f}",
        f"{signal_us:.1f}",
        f"{1000.0 * late_s:.3f}",
        int(missed),
        decision.detail,
    ]
