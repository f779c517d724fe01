"""Sessions with a device side for `betaloop control`: on the tablet's own clock, or on that of a simulated device."""

from __future__ import annotations

import signal
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import datetime, timedelta
from enum import StrEnum
from pathlib import Path

from app.platform.errors import Invalid
from app.tablet.simulated import SimulatedDevice, brain_of
from app.tablet.sources import Task, Wish
from ml.deploy.bundle import OpenBundle
from ml.deploy.manifest import BundleManifest
from ml.deploy.runtime.__main__ import LEDGER, open_link
from ml.deploy.runtime.control_loop import LEAD_S, End
from ml.deploy.runtime.decision_log import LogFailed
from ml.deploy.runtime.inputs import Event, Link, QueueLink, give_up_standard_output
from ml.deploy.runtime.ledger import Ledger
from ml.deploy.runtime.session import Outcome, Tablet, run_bench, run_slot
from ml.deploy.runtime.slot import NotAllowed, Refusal, read_withdrawals

BENCH_MINUTES = 10.0
"""Length of a bench session on a simulated device, of a bundle that states none."""


class DeviceSide(StrEnum):
    """Name of a device side in the command's input argument `SCHEME:REST`; the rest is the port, the file, or the simulated brain."""

    TCP = "tcp"
    TAIL = "tail"
    SIMULATED = "simulated"


_MEND = {
    Refusal.NO_SLOT: "Have the visit plan signed and take the session's bundle from it, or add --bench where nobody is connected.",
    Refusal.NOT_SIGNED: "Have the visit plan signed and take the bundle anew, or add --bench where nobody is connected.",
    Refusal.OTHER_PARTICIPANT: "A bundle is for its participant alone.",
    Refusal.TOO_EARLY: "It runs on the day of its visit; where the visit was moved, have the plan signed anew.",
    Refusal.EXPIRED: "Take a bundle of today's signed plan.",
    Refusal.CLOCK: "Set the tablet's clock; it decides whether a bundle is of today.",
    Refusal.WITHDRAWN: "Have the plan changed and signed, and take the session's bundle from it.",
    Refusal.ALREADY_RUN: "Add a repeat of the session to the plan, have it signed, and take its bundle.",
    Refusal.RUNNING: "Stop it there, or wait until it has ended.",
    Refusal.BROKEN_OFF: "Upload the log as it is; add a repeat to the plan to run the session again.",
}


def is_live(source: str, wish: Wish) -> bool:
    """Decide whether a source is a device side, which receives amplitudes."""
    return (source == "-" and wish.realtime) or _device_side(source) is not None


def _device_side(source: str) -> tuple[DeviceSide, str] | None:
    """Split a source into its scheme and what follows its colon; None for a file of recorded input."""
    scheme, colon, rest = source.partition(":")
    return (DeviceSide(scheme), rest) if colon and scheme in set(DeviceSide) else None


def _simulated_brain(source: str) -> str | None:
    """Return the brain that a simulated device is asked for; None where the source is no simulated device."""
    match _device_side(source):
        case DeviceSide.SIMULATED, brain:
            return brain
        case _:
            return None


def run_live(
    opened: OpenBundle, name: str, source: str, task: Task, now: Callable[[], datetime] = lambda: datetime.now().astimezone()
) -> tuple[Outcome, str]:
    """Run a bundle's session with a device side, or on the bench. Returns how it went, and what the source is.

    Args:
        opened: the bundle. name: of its file. source: as `is_live` knows it. task: log, key, ledger, withdrawals. now: the tablet's time.

    Raises:
        Invalid: it may not run, the input cannot be opened, or the log cannot be begun.
    """
    if task.begins is not None and _simulated_brain(source) is None:
        raise Invalid("A session with a device begins when it begins.", "Leave --begins out, or name a simulated device.")
    link, where = _link(opened.manifest, source)
    try:
        with _stopped_by_signals(link):
            outcome = _run(opened, link, task, now)
    except NotAllowed as refused:
        raise Invalid(f"{name} must not be run: {refused}.", _MEND.get(refused.code, "Take a bundle of the signed plan.")) from refused
    except LogFailed as error:
        raise Invalid(f"{str(error)[0].upper()}{str(error)[1:]}.", "Name a new file on a disk with free space.") from error
    if outcome.end is End.DEVICE_GONE and source == "-":
        give_up_standard_output()
    return outcome, where


def _run(opened: OpenBundle, link: Link, task: Task, now: Callable[[], datetime]) -> Outcome:
    manifest, sha256 = opened.manifest_json, opened.manifest_sha256
    if task.bench:
        seconds = 60 * BENCH_MINUTES if isinstance(link, SimulatedDevice) else None
        return run_bench(manifest, sha256, opened.controller(), link, task.log, seconds)
    if task.log is None:
        raise Invalid("A session with a device side needs a log.", "Name a new file with --log: it is what is uploaded afterwards.")
    withdrawn = None
    if task.withdrawn is not None:
        if opened.manifest.public_key is None:
            raise NotAllowed(Refusal.WITHDRAWN, "the bundle names no key to check the list of withdrawals with")
        withdrawn = read_withdrawals(task.withdrawn, bytes.fromhex(opened.manifest.public_key))
    tablet = Tablet(ledger=Ledger(task.ledger or LEDGER), withdrawn=withdrawn, now=now)
    if isinstance(link, SimulatedDevice):
        # on the simulation's clock, and noted apart, so that a simulated session neither uses up a real one nor sets the clock forward
        tablet = Tablet(
            ledger=Ledger(task.ledger or LEDGER / "simulated"), withdrawn=withdrawn, simulated=True, now=_clock(link, task, now)
        )
    return run_slot(manifest, sha256, opened.controller(), link, Path(task.log), tablet, task.participant)


def _clock(device: SimulatedDevice, task: Task, now: Callable[[], datetime]) -> Callable[[], datetime]:
    """Make the clock of a simulation: the time of day from its stated beginning, as its own clock goes on."""
    begins = (task.begins or now()).astimezone()
    return lambda: begins + timedelta(seconds=device.now())


def _link(manifest: BundleManifest, source: str) -> tuple[Link, str]:
    wanted = _simulated_brain(source)
    if wanted is not None:
        minutes = manifest.slot.minutes if manifest.slot else BENCH_MINUTES
        steps = int((60 * minutes + LEAD_S) / manifest.period_s) + 2
        brain = brain_of(wanted, manifest, steps)
        return SimulatedDevice(brain, manifest), f"simulated device, {brain.description}"
    try:
        link = open_link(source)
    except OSError as error:
        raise Invalid(f"The input '{source}' cannot be opened: {error}.", "Name -, tcp:PORT with a free port, or tail:FILE.") from error
    return link, "a device side on standard input" if source == "-" else f"a device side on {source}"


@contextmanager
def _stopped_by_signals(link: Link) -> Iterator[None]:
    """Make Ctrl-C and a stop of the system end the session on clinical settings, with its log whole."""
    if not isinstance(link, QueueLink):
        yield
        return
    before = {number: signal.signal(number, lambda *_: link.put(Event.STOP)) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
