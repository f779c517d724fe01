"""A session of the study in silico as a tablet runs it: the verified bundle of its slot, with a synthetic participant.

Only the participant and the clock differ from the clinic. The bundle, its verification and the check of day, withdrawal and ledger are the
same. So are the loop with its envelope, the line protocol with its device side, and the log.
"""

from __future__ import annotations

import datetime as dt
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from sqlalchemy.orm import Session

from app.accounts.permissions import Caller
from app.planning.bundles import service as bundles
from app.planning.bundles import slots
from app.platform.errors import BetaloopError
from app.tables.visits import Visit
from app.tablet.command import verified
from app.tablet.simulated import SimulatedDevice
from ml.deploy.manifest import BundleManifest
from ml.deploy.runtime.control_loop import LEAD_S, End
from ml.deploy.runtime.envelope import Signal
from ml.deploy.runtime.ledger import Ledger
from ml.deploy.runtime.session import Tablet, run_slot
from ml.deploy.runtime.slot import read_withdrawals
from ml.population import PARTICIPANTS
from ml.population.outcomes import GRASP_TEST_STEPS, Outcomes, measure
from ml.population.sessions import Simulation

TAKEN_BEFORE = dt.timedelta(minutes=1)
"""So long before its session a bundle is taken."""
_SYMPTOMS = ("brady", "tremor", "overload")


@dataclass(frozen=True, kw_only=True)
class Moment:
    """Start of a session, with the seeds of its day and its noise.

    Attributes:
        begins: of the runner; the controller takes over a window later. hour: since the day's first session. visit: number.
        seed: of the session's noise. study_seed: of the study's days.
    """

    begins: dt.datetime
    hour: float
    visit: int
    seed: int
    study_seed: int


@dataclass(frozen=True)
class Ran:
    """A session that was run: the log's bytes, when it ended, and what was measured at its end."""

    log: bytes
    ended: dt.datetime
    outcomes: Outcomes


class DayParticipant:
    """A synthetic participant in one session: beta answers the amplitude, and symptoms follow, as `ml.population.run_sessions` has them.

    Args:
        manifest: of the bundle, for window, period and cDBS amplitude. steps: of the session, after the window before it.
    """

    def __init__(self, code: str, manifest: BundleManifest, at: Moment, steps: int) -> None:
        self._model, self._steps, self._cdbs_ma = PARTICIPANTS[code], steps, manifest.cdbs_ma
        self._grasps_from = manifest.window + steps - GRASP_TEST_STEPS
        self._simulation = Simulation(
            self._model,
            visits=np.array([at.visit]),
            hours=np.array([at.hour]),
            seeds=np.array([at.seed], dtype=np.uint64),
            study_seeds=np.array([at.study_seed]),
            # a controller that takes over late makes its session end later
            periods=manifest.window + steps + int(LEAD_S / manifest.period_s) + 2,
        )
        self._trace: dict[str, list[float]] = {name: [] for name in ("amplitude", *_SYMPTOMS)}
        self.signal = Signal("uV", manifest.beta_source)  # the amplitude itself, whatever the device would make it from

    def beta(self, amplitude_ma: float) -> float:
        """Advance the simulation by one period under an amplitude, mA; return its beta."""
        fraction = amplitude_ma / self._cdbs_ma
        out = self._simulation.advance(np.array([fraction]), moving=self._simulation.period >= self._grasps_from)
        self._trace["amplitude"].append(fraction)
        for name in _SYMPTOMS:
            self._trace[name].append(float(out[name][0]))
        return float(out["beta"][0])

    def outcomes(self) -> Outcomes:
        """Measure the outcomes at the end, over the session without the window before it."""
        traces = [np.array(values[-self._steps :]) for values in self._trace.values()]
        return measure(self._model, self._simulation.counters[0], *traces)


def run_slot_of(db: Session, visit: Visit, position: int, at: Moment, folder: Path, caller: Caller) -> Ran:
    """Take the bundle of a session of the visit's signed plan, and run it. The caller commits the release of the bundle.

    Args:
        folder: the tablet of that day: bundles, logs, and the ledger of what ran.

    Raises:
        BetaloopError: the session may not run, or did not reach its end, which would be a fault of the simulator.
    """
    folder.mkdir(parents=True, exist_ok=True)
    name, content = slots.bundle(db, visit, position, caller, at.begins - TAKEN_BEFORE)
    listed = folder / "withdrawn.txt"
    listed.write_bytes(slots.withdrawals(db))
    file, log = folder / name, folder / f"session-{position}.csv"
    file.write_bytes(content)
    key = bundles.public_key()
    opened = verified(file, key)
    manifest = opened.manifest
    minutes = manifest.slot.minutes if manifest.slot else 0.0
    person = DayParticipant(visit.participant.code, manifest, at, round(60 * minutes / manifest.period_s))
    device = SimulatedDevice(person, manifest)
    tablet = Tablet(
        ledger=Ledger(folder / "ledger"),
        withdrawn=read_withdrawals(listed, bytes.fromhex(key)),
        simulated=True,
        now=_clock(at.begins, device.now),
    )
    code = visit.participant.code
    outcome = run_slot(opened.manifest_json, opened.manifest_sha256, opened.controller(), device, log, tablet, code)
    if outcome.end is not End.COMPLETE:
        raise BetaloopError(f"Session {position} of visit {visit.number} of {code} ended as {outcome.end}: {outcome.detail}.")
    return Ran(log.read_bytes(), tablet.now(), person.outcomes())


def _clock(begins: dt.datetime, seconds: Callable[[], float]) -> Callable[[], dt.datetime]:
    return lambda: begins + dt.timedelta(seconds=seconds())
