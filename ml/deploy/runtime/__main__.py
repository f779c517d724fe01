"""`python -m controller [FOLDER] [OPTIONS]`: check an unpacked bundle, and run its session with a device side.

    --key=KEY          the study's public key, 64 hexadecimal digits or a file with them: the manifest's signature is checked
    --run              run the session of the signed plan that the bundle is for, once, on the day of the visit; needs --key
    --input=INPUT      where the device side is: - (standard input and output, the default), tcp:PORT on this machine, or tail:FILE
    --log=FILE         the session's log, a new file
    --ledger=FOLDER    which sessions this tablet has run (default: .betaloop-tablet in the home folder)
    --withdrawn=FILE   the study's signed list of withdrawn policies and plans
    --bench            with --run: no person is connected; any bundle runs, and lone numbers count as beta
    --replay           with --run and --bench: one line per period, as fast as they come, with no clock
    --time=N           measure N decisions on this machine (200 where N is absent): mean and SD, milliseconds

The lines are those of `protocol.py`. Without --key hashes and test vectors are checked, and the signature is not.
"""

from __future__ import annotations

import hashlib
import json
import math
import re
import signal
import sys
from pathlib import Path
from typing import Any

import numpy as np

from .control_loop import End
from .controller import BoundedController
from .decision_log import LogFile, Row
from .envelope import BetaSample, EnvelopeLimits, Signal, reason_names
from .inputs import Event, LoopbackLink, QueueLink, from_growing_file, from_lines, give_up_standard_output
from .ledger import Ledger
from .network import MlpNetwork, Output
from .protocol import number
from .schedule import Schedule, ScheduledController
from .session import Outcome, Tablet, describe, is_blinded, latency, latency_words, parse_manifest, run_bench, run_slot
from .signature import verifies
from .slot import SEALED, NotAllowed, opened, read_withdrawals

_LIMITS = ("min_ma", "max_ma", "cdbs_ma", "ramp_ma_per_s", "window", "period_s", "max_beta_age_s")
_OPTIONAL_LIMITS = ("beta_max", "level_low", "level_high", "frozen_after", "most_imputed", "carried_over")
_WITH_VALUE = ("--key", "--input", "--log", "--ledger", "--withdrawn", "--time")
LEDGER = Path.home() / ".betaloop-tablet"
ENDED_WELL = (End.COMPLETE, End.STOPPED)


def main(arguments: list[str]) -> int:
    """Run the command. Exit code 0: everything agrees, and the session came to its end; 1: something did not, as standard error
    explains."""
    folder, options = _read(arguments)
    try:
        key = None if "--key" not in options else public_key(options["--key"])
        raw = (folder / "manifest.json").read_bytes()
        manifest = parse_manifest(raw)
        check_files(folder, manifest, raw, key)
        files = {name: folder / name for name in ("test_vectors.json", "weights.f32")}
        read = {name: path.read_bytes() for name, path in files.items() if path.exists()}
        if manifest.get("sealed"):
            manifest, read = opened(manifest, (folder / SEALED).read_bytes())
        network = None if manifest.get("schedule") else _network(read, manifest)
        worst, worst_ma = check(manifest, network, json.loads(read["test_vectors.json"]))
    except (OSError, ValueError, KeyError, TypeError) as error:
        sys.stderr.write(f"this bundle cannot be used: {error}\n")
        return 1
    said = "signature right, " if key else ""
    # of a schedule no fraction is compared, so that the difference would reveal what runs
    how = "" if is_blinded(manifest) else f": worst difference {worst:.3g} of a fraction, {worst_ma:.3g} mA"
    sys.stderr.write(f"{said}test vectors agree{how}\n")
    controller = make_controller(manifest, network)
    if "--time" in options:
        _tell_time(manifest, controller, int(options["--time"] or 200))
    return _run(manifest, hashlib.sha256(raw).hexdigest(), controller, options, key) if "--run" in options else 0


def _tell_time(manifest: dict[str, Any], controller: BoundedController, decisions: int) -> None:
    """Log the time per decision. Hide it from a blinded screen: it reveals the network's size."""
    if is_blinded(manifest):
        sys.stdout.write(f"{_what(manifest)}: what a decision takes stands masked in its log\n")
        return
    sys.stdout.write(f"{_what(manifest)}: {latency_words(latency(manifest, controller, decisions))}\n")


def _read(arguments: list[str]) -> tuple[Path, dict[str, str]]:
    """Parse the folder, and the options with their values, written `--name=value` or `--name value`."""
    folder, options, waits = Path("."), {}, ""
    for argument in arguments:
        name, given, value = argument.partition("=")
        if name.startswith("--"):
            options[name] = value
            waits = name if name in _WITH_VALUE and not given else ""
        elif waits and not (waits == "--time" and not argument.isdecimal()):
            options[waits], waits = argument, ""
        else:
            folder, waits = Path(argument), ""
    return folder, options


def _what(manifest: dict[str, Any]) -> str:
    """Name the controller's owner and its size: the paper compares full policies with distilled ones."""
    slot = manifest.get("slot") or {}
    if is_blinded(manifest):
        return f"{manifest['participant']}, session {manifest['card']['head']}, blinded"
    size = f"{' x '.join(map(str, manifest['layers'][1:-1]))} units" if manifest.get("layers") else ""
    told = [manifest["participant"], manifest["policy_name"], slot.get("controller", ""), size]
    return ", ".join(str(text) for text in told if text)


def public_key(text: str) -> bytes:
    """Read the 32 bytes of a key given as digits or as a file with them. Raises ValueError, OSError."""
    digits = text.strip()
    if not re.fullmatch(r"[0-9a-fA-F]{64}", digits):
        digits = Path(text).read_text("ascii").strip()
    if not re.fullmatch(r"[0-9a-fA-F]{64}", digits):
        raise ValueError("the key is not 64 hexadecimal digits")
    return bytes.fromhex(digits)


def check_files(folder: Path, manifest: dict[str, Any], raw: bytes, key: bytes | None) -> None:
    """Raise ValueError where a file is another than the manifest names or, with a key, the manifest is not signed by it."""
    for name, digest in manifest["files"].items():
        if hashlib.sha256((folder / name).read_bytes()).hexdigest() != digest:
            raise ValueError(f"{name} is not the file that the manifest names")
    if key is not None and not verifies(key, raw, (folder / "manifest.sig").read_bytes()):
        raise ValueError("the manifest is not signed with this key")


def check(manifest: dict[str, Any], network: MlpNetwork | None, vectors: dict[str, Any]) -> tuple[float, float]:
    """Compute the worst differences of fractions and of decisions (mA) from the test vectors. Raises ValueError where one is too large."""
    worst = worst_ma = 0.0
    if network is not None:
        worst = float(np.abs(network.act(np.array(vectors["windows"])) - np.array(vectors["expected"])).max())
    controller = make_controller(manifest, network)
    for step in vectors["session"]:
        sample = None
        if step["t_s"] is not None:
            beta = math.nan if step["beta"] is None else float(step["beta"])
            sample = BetaSample(step["t_s"], beta, Signal(step["unit"], step["source"]))
        decision = controller.decide(step["now_s"], sample)
        worst_ma = max(worst_ma, abs(decision.amplitude_ma - step["amplitude_ma"]))
        if list(reason_names(decision.reasons)) != step["reasons"]:
            raise ValueError(f"at {step['now_s']} s the reasons are {reason_names(decision.reasons)} instead of {step['reasons']}")
    if not (worst <= vectors["tolerance"] and worst_ma <= vectors["tolerance"] * manifest["cdbs_ma"]):
        raise ValueError(f"the answers differ from the test vectors by {worst:.3g} of a fraction and {worst_ma:.3g} mA")
    return worst, worst_ma


def make_controller(manifest: dict[str, Any], network: MlpNetwork | None) -> BoundedController:
    """Make the network or schedule of a manifest within its limits. Raises ValueError, KeyError, TypeError for a manifest that is none."""
    stated = {name: manifest[name] for name in _LIMITS} | {name: manifest[name] for name in _OPTIONAL_LIMITS if name in manifest}
    limits, said = EnvelopeLimits(**stated), Signal(manifest["beta_unit"], manifest["beta_source"])
    if manifest.get("schedule"):
        return ScheduledController(Schedule.from_json(manifest["schedule"]), limits, said)
    if network is None:
        raise ValueError("the bundle has neither network nor schedule")
    return BoundedController(network, limits, said)


def _network(files: dict[str, bytes], manifest: dict[str, Any]) -> MlpNetwork:
    if "weights.f32" not in files:
        raise ValueError("it has no layers that this runner can run; `betaloop control` runs it")
    return MlpNetwork.from_bytes(
        files["weights.f32"],
        manifest["layers"],
        manifest["normalisation_mean"],
        manifest["normalisation_std"],
        manifest["activations"],
        Output(*(manifest[f"output_{name}"] for name in Output._fields)),
    )


def _run(manifest: dict[str, Any], manifest_sha256: str, controller: BoundedController, options: dict[str, str], key: bytes | None) -> int:
    log = Path(options["--log"]) if options.get("--log") else None
    try:
        if "--bench" in options and "--replay" in options:
            replay(manifest, manifest_sha256, controller, log)
            return 0
        link = open_link(options.get("--input", "-"))
        _stop_on_signals(link)
        if "--bench" in options:
            outcome = run_bench(manifest, manifest_sha256, controller, link, log, None)
        else:
            if key is None or log is None:
                sys.stderr.write("a session needs --key and --log; add --bench where nobody is connected\n")
                return 1
            withdrawn = read_withdrawals(Path(options["--withdrawn"]), key) if "--withdrawn" in options else None
            tablet = Tablet(ledger=Ledger(Path(options.get("--ledger", LEDGER))), withdrawn=withdrawn)
            outcome = run_slot(manifest, manifest_sha256, controller, link, log, tablet)
    except NotAllowed as refused:
        sys.stderr.write(f"not run: {refused}\n")
        return 1
    except BrokenPipeError:
        give_up_standard_output()
        sys.stderr.write("nobody reads the amplitudes any more\n")
        return 1
    except OSError as error:
        sys.stderr.write(f"{error}\n")
        return 1
    return _report(outcome)


def _report(outcome: Outcome) -> int:
    if outcome.end is End.DEVICE_GONE:
        give_up_standard_output()
        sys.stderr.write("nobody reads the amplitudes any more\n")
    else:
        detail = f" ({outcome.detail})" if outcome.detail else ""
        sys.stderr.write(f"ended after {len(outcome.session.decisions)} decisions, on clinical settings: {outcome.end.value}{detail}\n")
    return 0 if outcome.end in ENDED_WELL else 1


def open_link(where: str) -> QueueLink:
    """Open the device side at `-`, `tcp:PORT` or `tail:FILE`. Raises ValueError for another text, OSError for a port that is taken."""
    kind, _, rest = where.partition(":")
    if where == "-":
        return from_lines(sys.stdin)
    if kind == "tcp" and rest.isdecimal() and int(rest) < 65536:
        link = LoopbackLink(int(rest))
        sys.stderr.write(f"waiting for a device side on port {link.port} of this machine\n")
        return link
    if kind == "tail" and rest:
        return from_growing_file(Path(rest))
    raise OSError(f"the input '{where}' is none of -, tcp:PORT and tail:FILE")


def _stop_on_signals(link: QueueLink) -> None:
    """Make Ctrl-C and a stop of the system end the session as the stop button does: on clinical settings, with its log whole."""
    for name in (signal.SIGINT, signal.SIGTERM):
        signal.signal(name, lambda *_: link.put(Event.STOP))


def replay(manifest: dict[str, Any], manifest_sha256: str, controller: BoundedController, log: Path | None) -> None:
    """Read one lone number per period from standard input, as fast as they come; write amplitudes and reasons. For tests of a bundle.

    Raises:
        LogFailed: the log is there already or cannot be written. BrokenPipeError: the reader of the amplitudes is gone.
    """
    facts = describe(manifest, manifest_sha256, controller, Tablet(ledger=Ledger(LEDGER)).now(), "replay")
    sink = None if log is None else LogFile(log, manifest["period_s"], facts)
    said = Signal(manifest["beta_unit"], manifest["beta_source"])
    for k, line in enumerate(sys.stdin):
        sample = BetaSample(k * manifest["period_s"], number(line.strip()), said)
        decision = controller.decide(sample.t_s, sample)
        sys.stdout.write(f"{decision.amplitude_ma:.6g} {' '.join(reason_names(decision.reasons))}\n")
        sys.stdout.flush()
        if sink:
            sink.write(
                Row(sample.t_s, sample, decision, list(controller.window), 0.0, drawn=None if decision.fallback else controller.drawn())
            )
    if sink:
        sink.close()


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
