"""Hazard log in the form of ISO 14971: hazards of a controller, their controls, and the tests that verify the controls.

The hazards are data, here and nowhere else. The tests of a control are read from the tests themselves, which carry the hazard's number
(`@pytest.mark.hazard("H01")`). `python -m app.tablet.hazards` writes docs/hazards.md.
"""

from __future__ import annotations

import ast
import sys
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "hazards.md"


class Harm(StrEnum):
    """Harm to a participant."""

    UNDER = "under: too little stimulation, symptoms return"
    OVER = "over: too much stimulation, side effects"
    SWINGS = "jumps: amplitudes that jump, discomfort, falls"
    WRONG_RECORD = "record: a wrong record, from which later controllers learn"


class Severity(StrEnum):
    """Severity of a harm before any control. S4 does not occur: the stimulator's own limits apply outside of betaloop."""

    S1 = "S1: inconvenience, or a session to repeat"
    S2 = "S2: passing discomfort, ends with the session or with the programmer"
    S3 = "S3: injury is possible, such as a fall or dyskinesia that needs a clinician"


class Likelihood(StrEnum):
    """Likelihood of a hazard over a study, judged, not measured."""

    P1 = "P1: not expected in a study"
    P2 = "P2: once in a study"
    P3 = "P3: at some visits"
    P4 = "P4: at most visits"


@dataclass(frozen=True)
class Hazard:
    """One entry of the log.

    Attributes:
        number: `H01`, ...; never given to another one.
        situation: what goes wrong. harms: what it would do. severity, before: without the control; after: likelihood with it.
        control: the measure against it, and where. residual: the remaining risk, which the clinician must know.
    """

    number: str
    situation: str
    harms: tuple[Harm, ...]
    severity: Severity
    before: Likelihood
    control: str
    after: Likelihood
    residual: str


_U, _O, _S, _R = Harm.UNDER, Harm.OVER, Harm.SWINGS, Harm.WRONG_RECORD
_S1, _S2, _S3 = Severity.S1, Severity.S2, Severity.S3
_P1, _P2, _P3, _P4 = Likelihood.P1, Likelihood.P2, Likelihood.P3, Likelihood.P4

HAZARDS: tuple[Hazard, ...] = (
    Hazard(
        "H01", "The bundle of another participant is started", (_U, _O), _S3, _P2,
        "The signed manifest names the participant, and the device side names who is connected. Any other name ends the session before "
        "it begins. `--participant` checks the code on the chart.",
        _P1,
        "A device side set up with the wrong code is believed. The sheet asks to compare it with the programmer.",
    ),
    Hazard(
        "H02", "The controller is connected to the other side, or to another device", (_U, _O), _S3, _P2,
        "Side, unit, source and period are in the device's first line and must be the bundle's. Without that line only cDBS is sent. "
        "Recordings of the other side are not used.",
        _P1, "Leads swapped in the stimulator itself look right. Contacts and side are on the sheet.",
    ),
    Hazard(
        "H03", "Beta comes in another unit, or from another source", (_U, _O), _S3, _P3,
        "Each value states unit and source. A window whose mean is far from every logged level gives cDBS, whatever unit "
        "it states.",
        _P1, "A scale error below about twice stays within the logged range.",
    ),
    Hazard(
        "H04", "A policy asks for nearly nothing", (_U,), _S3, _P3,
        "Unsafe policies need a stated override in the plan. The clinician's lowest amplitude applies whatever the network answers. "
        "Sheet and page warn of policies that ask for less than was ever tried.",
        _P1, "The lowest amplitude itself may treat badly: stop rules and the stop button remain.",
    ),
    Hazard(
        "H05", "An amplitude leaves the limits", (_O, _U), _S3, _P2,
        "The envelope outside the network cuts every answer to the clinician's limits, which are within the stimulator's own. The "
        "device side has limits of its own and leaves them for no message.",
        _P1, "Limits may be stated wrongly. They are signed with the plan, before any bundle is made.",
    ),
    Hazard(
        "H06", "The amplitude changes too fast", (_S,), _S2, _P4,
        "The clinician's ramp bounds the change from one decision to the next. A late decision gets one period's worth.",
        _P1, "The return to cDBS is not ramped, so that no participant stays under-treated on a signal that is not trusted.",
    ),
    Hazard(
        "H07", "Beta is stale or missing", (_U, _O), _S2, _P4,
        "The runner keeps its own clock and decides in every period. Beta that is late by a fifth of a period, or older than 0.9 of a "
        "period, gives cDBS.",
        _P1, "A lost value costs one decision; more than learning imputes cost a window.",
    ),
    Hazard(
        "H08", "Beta is no number, or the network fails", (_U, _O), _S2, _P3,
        "A value that is no amplitude gives cDBS, and a wrong one a new window. "
        "An answer outside [0, 1] and an error of the network give cDBS.",
        _P1, "None known.",
    ),
    Hazard(
        "H09", "Beta is saturated", (_U, _O), _S2, _P3,
        "A value above three times the highest logged one counts as saturated, and gives cDBS.",
        _P1, "Where nothing was logged, no bound is known. The bundle's sheet says so.",
    ),
    Hazard(
        "H10", "Beta is frozen: the same value comes again and again", (_U, _O), _S2, _P2,
        "A row of equal values counts as frozen and gives cDBS.",
        _P1, "Four values pass before the fifth shows it.",
    ),
    Hazard(
        "H11", "Messages are repeated, lost or cut off, or the link breaks", (_U, _O), _S2, _P3,
        "Numbers that repeat, skip or restart, lines that are no message, and a lost connection give cDBS within one period and a new "
        "window.",
        _P1, "None known.",
    ),
    Hazard(
        "H12", "The clock of the device jumps", (_U, _O), _S2, _P2,
        "The device's times are compared with the runner's own monotonic clock. A jump gives cDBS and a new window. In the envelope a "
        "clock that runs back does the same.",
        _P1, "A clock that is off by less than half a period from one value to the next is not noticed.",
    ),
    Hazard(
        "H13", "The tablet stands still or sleeps", (_U, _O), _S2, _P3,
        "The clock continues while the tablet sleeps. Values that waited are old when it wakes. A missed deadline gives cDBS and a new "
        "window. After a standstill that triggered the device side's watchdog, the session ends.",
        _P1, "None known.",
    ),
    Hazard(
        "H14", "A fault or an attacker floods the runner with lines", (_S, _U), _S2, _P1,
        "At most one decision in half a period; a bound on lines that wait and on their length. The port is open to this machine "
        "alone, and the first device keeps it.",
        _P1, "A person with control of the tablet has control of its controller: lock it.",
    ),
    Hazard(
        "H15", "The session does not end", (_U, _O), _S2, _P2,
        "It ends after its minutes, at midnight, or when stopped on the tablet or the device. Its last line is the return to clinical "
        "settings.",
        _P1, "None known.",
    ),
    Hazard(
        "H16", "The runner, or the link to the device, dies", (_U, _O), _S3, _P3,
        "The protocol has a watchdog: after two missing messages the device side returns to clinical settings, shown with the "
        "runner killed. Whole rows of the log are on disk. Lines that are cut off or old are no messages.",
        _P1, "A device side without the watchdog must not be connected. The reference shows what it does.",
    ),
    Hazard(
        "H17", "A session is started again after a crash", (_U, _R), _S2, _P2,
        "A slot runs once: it is used when its policy has decided, which is on disk before that amplitude leaves. The next start refuses "
        "and reports when the session was interrupted and after how many decisions. The device stays on clinical settings.",
        _P1, "Another tablet does not know of it. The study notices the second log.",
    ),
    Hazard(
        "H18", "An outdated bundle runs: yesterday's, or of a plan that was replaced", (_U, _O), _S3, _P2,
        "A bundle names its visit's day and runs on no other. Replaced plans are on the study's signed list of withdrawals. A clock "
        "set back by a day is noticed.",
        _P1, "On the day itself the list must reach the tablet.",
    ),
    Hazard(
        "H19", "A bundle runs that nobody signed, or that was changed", (_U, _O), _S3, _P2,
        "Signature, hashes of all files and test vectors are checked at every start. A bundle without a slot of a signed plan runs "
        "on the bench alone. Bundles leave for the slots of signed plans.",
        _P1, "The bundle's own runner may be changed too. `betaloop control` checks from outside.",
    ),
    Hazard(
        "H20", "A policy is used after it was withdrawn", (_U, _O), _S3, _P2,
        "No bundle leaves for it. A bundle that has left is refused if the study's signed list of withdrawals names it. A list once "
        "seen is remembered, and no older one replaces it.",
        _P1, "On the day itself the list must reach the tablet.",
    ),
    Hazard(
        "H21", "A log is uploaded for another participant or session, or its steps are shifted by one", (_R,), _S2, _P3,
        "A log names its participant, signed bundle and slot. Uploaded for another participant it is refused. Each row has beta and "
        "the amplitude in force while it was measured.",
        _P1, "Logs older than version 2 name nothing. A person assigns them.",
    ),
    Hazard(
        "H22", "Two forms of a controller answer differently", (_U, _O), _S3, _P2,
        "Reference runner, ONNX file and C header must give the same decisions on the same test vectors, within 1e-5 of a "
        "fraction, on the tablet too.",
        _P1, "None known.",
    ),
    Hazard(
        "H23", "A random session stays low for long, or its draws are lost", (_U, _R), _S2, _P2,
        "Its amplitudes are fixed before the visit and signed with the bundle. They run within the same envelope, low ones at the end "
        "alone. Each row of the log has its hold and density.",
        _P1, "The session is unpleasant by design. A stop ends it on clinical settings.",
    ),
    Hazard(
        "H24", "An adverse event is written down, and the controller goes on", (_U, _O), _S3, _P2,
        "Entries of the clinic day, adverse events and its own Stop included, do not signal the control loop. The person who runs the "
        "session stops the controller on its tablet (Ctrl-C, or the device's stop). It returns to cDBS, the clinical settings, at once. "
        "The form of an adverse event asks for this first. After a severe one the page repeats it until the return is confirmed. A policy "
        "with a serious event is unsafe until a clinician clears it: no plan takes it without a clinician's reason. Until the event is "
        "cleared or a newer reason is signed, no further session of a signed plan starts, no bundle leaves, and the list of withdrawals "
        "names it.",
        _P1, "It depends on the person who runs the session: no entry stops a running session. A bundle already on the tablet is refused "
        "once the new list of withdrawals reaches it.",
    ),
)  # fmt: skip


def marked_tests(folder: Path) -> dict[str, list[str]]:
    """Read the tests' hazard marks from their source: sorted `path::name` from the project's root, by hazard number."""
    found: dict[str, list[str]] = {}
    for path in sorted(folder.rglob("test_*.py")):
        for node in ast.walk(ast.parse(path.read_text("utf-8"))):
            if isinstance(node, ast.FunctionDef):
                for number in _numbers(node.decorator_list):
                    found.setdefault(number, []).append(f"{path.relative_to(ROOT).as_posix()}::{node.name}")
    return {number: sorted(names) for number, names in found.items()}


def _numbers(decorators: Sequence[ast.expr]) -> Iterator[str]:
    for one in decorators:
        if isinstance(one, ast.Call) and ast.unparse(one.func) == "pytest.mark.hazard":
            yield from (str(argument.value) for argument in one.args if isinstance(argument, ast.Constant))


def page(tests: Mapping[str, Sequence[str]]) -> str:
    """Write the text of docs/hazards.md, in Markdown."""
    lines = [
        "# Hazard log", "",
        "How could a controller harm, which control applies, which risk remains, and which tests verify the control? In the form of",
        "ISO 14971. `python -m app.tablet.hazards` writes this page from `app/tablet/hazards.py` and the tests; a test keeps it current.",
        "A hazard without a test that passes fails `make test`.", "",
        "**Severities and likelihoods are judgements of the authors, without data on betaloop in use.** A study reviews and signs",
        "them with its own device and its own risk management.", "",
        "| | meaning |", "|---|---|",
        *["| **{}** | {} |".format(*one.value.split(": ", 1)) for kind in (Harm, Severity, Likelihood) for one in kind], "",
        "| | situation | harm | before | control | after | what remains |", "|---|---|---|---|---|---|---|",
    ]  # fmt: skip
    lines += [
        f"| {h.number} | {h.situation} | {', '.join(x.split(':')[0] for x in h.harms)} | {h.severity.name} {h.before.name} | {h.control} | "
        f"{h.severity.name} {h.after.name} | {h.residual} |"
        for h in HAZARDS
    ]
    lines += ["", "## Tests", "", "Folders begin with `tests`.", "", "| | file: tests |", "|---|---|"]
    for hazard in HAZARDS:
        files: dict[str, list[str]] = {}
        for path, _, name in (test.partition("::") for test in tests.get(hazard.number, [])):
            files.setdefault(path.removeprefix("tests/"), []).append(f"`{name}`")
        lines.append(f"| {hazard.number} | {'; '.join(f'{path}: ' + ', '.join(names) for path, names in files.items())} |")
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    PAGE.write_text(page(marked_tests(ROOT / "tests")), "utf-8")
    sys.stdout.write(f"wrote {PAGE}\n")
