"""Simulated sessions as the small files a clinic would upload: the step table, the tremor export and the grasp test."""

from __future__ import annotations

from datetime import UTC, datetime
from typing import Final

from ml.population.outcomes import TREMOR_CLASSES
from ml.population.physiology.brain import PERIOD_S
from ml.population.sessions import SimulatedSession

TREMOR_COLUMNS: Final = ("mild", "moderate", "none", "slight", "strong", "unknown")


def session_table_csv(session: SimulatedSession) -> bytes:
    """Write columns `t_s,beta,amplitude_fraction`, one row per 2 s; beta in uV.

    Row t_s = 2(k + 1) holds step k; rows with t_s <= 0 are the window before the session, the newest at 0.
    """
    lines = ["t_s,beta,amplitude_fraction"]
    lead = session.lead_beta.size
    for i, beta in enumerate(session.lead_beta):
        lines.append(f"{PERIOD_S * (i - lead + 1):g},{float(beta)!r},{session.lead_amplitude!r}")
    for k, (beta, amplitude) in enumerate(zip(session.beta, session.amplitude, strict=True)):
        lines.append(f"{PERIOD_S * (k + 1):g},{float(beta)!r},{float(amplitude)!r}")
    return ("\n".join(lines) + "\n").encode()


def strivepd_csv(session: SimulatedSession, *, started_ms: int) -> bytes:
    """Write tremor as a watch exports it: one row per minute, fractions of classes in alphabetical columns; one class per minute here."""
    lines = ["time," + ",".join(TREMOR_COLUMNS)]
    for i, name in enumerate(session.tremor_minutes):
        assert name in TREMOR_CLASSES
        time = datetime.fromtimestamp(started_ms / 1000 + 60 * i, UTC).strftime("%Y-%m-%dT%H:%M:%SZ")
        lines.append(f"{time}," + ",".join("1.0" if column == name else "0.0" for column in TREMOR_COLUMNS))
    return ("\n".join(lines) + "\n").encode()


def grasps_csv(session: SimulatedSession) -> bytes:
    """Write open-fist times of the grasp test: one column `open_fist_s`, seconds from the start of the test."""
    return ("open_fist_s\n" + "".join(f"{t:.3f}\n" for t in session.open_fist_s)).encode()
