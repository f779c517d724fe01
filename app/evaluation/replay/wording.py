"""Sentences of the comparison, made at the last moment."""

from __future__ import annotations

from app.evaluation.replay.schemas import DifferenceOut, ReplayOut

ALIKE = 0.005
"""Policies closer than this on average, fraction of cDBS, ask for the same on average: less than the device resolves."""


def amplitude(found: ReplayOut, fraction: float | None) -> str:
    """An amplitude in mA; as a share of cDBS where that is not known in mA."""
    if fraction is None:
        return "—"
    ma = found.cdbs_amplitude_ma
    return f"{fraction * ma:.2f} mA" if ma is not None else f"{100 * fraction:.0f} % of cDBS"


def differences(found: ReplayOut) -> list[str]:
    """How the policies differ, a sentence for each pair."""
    names = {a.policy_id: a.name for a in found.asked}
    return [_difference(found, d, names[d.policy_id], names[d.other_id]) for d in found.differences]


def _difference(found: ReplayOut, d: DifferenceOut, one: str, other: str) -> str:
    if d.apart == 0:
        return f"{one} and {other} would have asked for the same throughout, within 5 % of the cDBS amplitude."
    mean = amplitude(found, abs(d.mean_fraction))
    if abs(d.mean_fraction) < ALIKE:
        average = f"{one} and {other} would have asked for the same on average"
    else:
        average = f"{one} would have asked for {mean} {'more' if d.mean_fraction > 0 else 'less'} than {other} on average"
    minutes, seconds = divmod(round(d.most_at_s), 60)
    most = f"{amplitude(found, abs(d.most))} {'more' if d.most > 0 else 'less'}"
    often = f"{100 * d.apart:.0f} % of the steps"
    return f"{average}; they are apart in {often}, most at {minutes} min {seconds:02d} s, where {one} asks for {most}."
