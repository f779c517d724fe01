"""Head of a controller's log: version, period, and what ran for whom, in which slot of which signed plan.

Version 1 has its period alone. Version 2 adds policy, network, side and limits in the same line; version 3 has all of it as JSON in a
second line.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from datetime import date, datetime
from typing import Any, cast

from ml.formats.options import DecodeOptions
from ml.formats.recording import Hemisphere, UndecodableFile
from ml.formats.tables.amplitudes import LARGEST
from ml.formats.tables.columns import LOG_KIND_LINE
from ml.formats.tables.masked import facts_of
from ml.formats.tables.steps import GRID_TOLERANCE

NEWEST = 3
"""Version of logs that this decoder reads at the most."""
PURPOSES = ("session", "bench", "replay")
DESIGNS = ("paper", "stratified", "ladder", "near")
CONTROLLERS = ("cdbs", "rl", "distilled", "no_dbs", "random", "other")
ENDS = (
    "complete", "stopped", "input_ended", "other_device", "device_gone", "log_failed", "expired", "stood_still", "fault",
)  # fmt: skip
MEND = f"Upload the log as the controller wrote it, with its first line ('{LOG_KIND_LINE}')."
_KIND = re.compile(r"# betaloop controller log, version (?P<version>\d{1,4})(, period (?P<period>\d+(\.\d*)?) s(?P<ran>.*))?")
_NUMBER = r"\d{1,3}(?:\.\d{1,9})?"
_RAN = re.compile(
    r", policy (?P<policy_id>\d{1,9}), network (?P<network_sha256>[0-9a-f]{64})(?:, side (?P<side>left|right))?"
    rf", limits (?P<min_ma>{_NUMBER}) to (?P<max_ma>{_NUMBER}) mA, cDBS (?P<cdbs_ma>{_NUMBER}) mA, ramp (?P<ramp_ma_per_s>{_NUMBER}) mA/s"
)
_SHA256 = re.compile(r"[0-9a-f]{64}")
_CODE = re.compile(r"[A-Za-z0-9_.-]{1,40}")
_LONGEST = 8000

STATED_FIELDS = ("lower_bound", "design", "design_parameters")
"""What may be stated of the design of a random session: B, the name, and levels and holds."""


@dataclass(frozen=True, kw_only=True)
class Ran:
    """Description of the controller in the head of a log.

    Attributes:
        policy_id, network_sha256: the policy, by number and by the SHA-256 of its network; None where a schedule ran. side: hemisphere.
        min_ma, max_ma, cdbs_ma, ramp_ma_per_s: limits of the bundle.
    and from version 3 on:
        purpose: `session` of a signed plan, `bench` (no participant connected) or `replay` (of a recording or simulation).
        participant: code. manifest_sha256: of the bundle. started_at: ISO 8601 with its offset.
        plan_id, slot_id, position, repeat, controller, visit_number, visit_date: the slot.
        simulated: whether the device side was a simulation; None where it was not.
        design, level, seed, lower_bound: of a random session. latency_us: of decisions on this tablet: `n`, `mean`, `std`, `median`, `p99`.
    """

    policy_id: int | None
    network_sha256: str | None
    side: Hemisphere | None
    min_ma: float
    max_ma: float
    cdbs_ma: float
    ramp_ma_per_s: float
    purpose: str | None = None
    participant: str | None = None
    manifest_sha256: str | None = None
    started_at: str | None = None
    plan_id: int | None = None
    slot_id: int | None = None
    position: int | None = None
    repeat: int | None = None
    controller: str | None = None
    visit_number: int | None = None
    visit_date: str | None = None
    simulated: bool | None = None
    design: str | None = None
    level: float | None = None
    seed: int | None = None
    lower_bound: float | None = None
    latency_us: dict[str, float] | None = None

    def __post_init__(self) -> None:
        if not 0 <= self.min_ma <= self.cdbs_ma <= self.max_ma <= LARGEST["amplitude_ma"]:
            what = f"limits of {self.min_ma:g} to {self.max_ma:g} mA around a cDBS amplitude of {self.cdbs_ma:g} mA"
            raise UndecodableFile(what, "line 1", MEND)

    @property
    def counts_from_take_over(self) -> bool:
        """True where a device side was connected, so that the session begins when the controller takes over."""
        return self.purpose in ("session", "bench")


def read_head(lines: Iterator[str], options: DecodeOptions) -> tuple[float, Ran | None, str, str | None]:
    """Read the head of a file from its lines: the period, s, what ran, the head for storage, and the nonce of a blinded log.

    Raises:
        UndecodableFile: the head is cut, or of another version or period.
    """
    first = next(lines, "").strip().rstrip(", ;")
    kind = _KIND.match(first)
    if kind is not None and int(kind["version"]) > NEWEST:
        what = f"a controller's log of version {kind['version']}; this service reads versions up to {NEWEST}"
        raise UndecodableFile(what, "line 1", "Bring this service up to date.")
    if kind is None or kind["ran"] is None:
        raise _cut("line 1")
    period_s = float(kind["period"])
    if abs(period_s - options.period_s) > GRID_TOLERANCE * options.period_s:
        what = f"a controller that decided every {period_s:g} s, where the participant's period is {options.period_s:g} s"
        raise UndecodableFile(what, "line 1", "Set the participant's period to the controller's.")
    version, said = int(kind["version"]), _RAN.fullmatch(kind["ran"])
    if version == 2 and said is not None:
        limits: dict[str, Any] = {name: float(said[name]) for name in ("min_ma", "max_ma", "cdbs_ma", "ramp_ma_per_s")}
        side = cast("Hemisphere | None", said["side"])
        ran = Ran(policy_id=int(said["policy_id"]), network_sha256=said["network_sha256"], side=side, **limits)
        return options.period_s, ran, first, None
    if version == 2 or kind["ran"]:
        raise _cut("line 1")
    if version == 1:
        return options.period_s, None, first, None
    ran, nonce = _parse_description(next(lines, "").strip().removeprefix('"').removesuffix('"'))
    kept = {_SAID_AS.get(name, name): value for name, value in asdict(ran).items() if value is not None}
    return options.period_s, ran, f"{first}\n# {json.dumps(kept, sort_keys=True)}", nonce


def _cut(where: str) -> UndecodableFile:
    return UndecodableFile("the first line of this controller's log is not whole", where, MEND)


def _parse_description(line: str) -> tuple[Ran, str | None]:
    """Parse the JSON line of version 3, entry by entry, and the nonce of a blinded log. An entry of the wrong kind is ignored: no runner
    wrote it."""
    try:
        said = json.loads(line.removeprefix("# ")) if line.startswith("# ") and len(line) <= _LONGEST else None
    except ValueError:
        said = None
    if not isinstance(said, Mapping):
        raise _cut("line 2")
    nonce = None
    if said.get("sealed") is not None:
        nonce, kept = _unseal(said["sealed"])
        said = {**kept, **{name: value for name, value in said.items() if name != "sealed"}}
    found: dict[str, Any] = {}
    for name, kind in _ENTRIES.items():
        written = _SAID_AS.get(name, name)
        value = said.get(written)
        if value is None and name not in _NEEDED:
            continue
        try:
            found[name] = kind(value)
        except (TypeError, ValueError, KeyError) as error:
            what = f"the entry {written} of this controller's log is missing, or of another kind"
            raise UndecodableFile(what, "line 2", MEND) from error
    return Ran(**{"policy_id": None, "network_sha256": None, "side": None} | found), nonce


def _unseal(text: Any) -> tuple[str, dict[str, Any]]:
    try:
        return facts_of(str(text))
    except ValueError as error:
        raise UndecodableFile("the masked entry of this blinded log is not whole", "line 2", MEND) from error


_SAID_AS = {"side": "hemisphere"}
_NEEDED = ("min_ma", "max_ma", "cdbs_ma", "ramp_ma_per_s", "purpose", "participant", "manifest_sha256")


def _one_of(words: tuple[str, ...]) -> Callable[[Any], str]:
    def check(value: Any) -> str:
        if value not in words:
            raise ValueError(f"none of {', '.join(words)}")
        return str(value)

    return check


def _matching(pattern: re.Pattern[str]) -> Callable[[Any], str]:
    def check(value: Any) -> str:
        if not isinstance(value, str) or not pattern.fullmatch(value):
            raise ValueError("a text of another form")
        return value

    return check


def _number(value: Any) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value) or abs(value) > 1e9:
        raise ValueError("no number")
    return float(value)


def _whole(value: Any) -> int:
    if isinstance(value, bool) or not isinstance(value, int) or not 0 <= value < 2**53:
        raise ValueError("no whole number")
    return value


def _moment(value: Any) -> str:
    moment = datetime.fromisoformat(str(value))
    if moment.tzinfo is None:
        raise ValueError("a time without its offset from UTC")
    return moment.isoformat()


_ENTRIES: dict[str, Callable[[Any], Any]] = {
    "policy_id": _whole,
    "network_sha256": _matching(_SHA256),
    "side": _one_of(("left", "right")),
    "min_ma": _number,
    "max_ma": _number,
    "cdbs_ma": _number,
    "ramp_ma_per_s": _number,
    "purpose": _one_of(PURPOSES),
    "participant": _matching(_CODE),
    "manifest_sha256": _matching(_SHA256),
    "started_at": _moment,
    "plan_id": _whole,
    "slot_id": _whole,
    "position": _whole,
    "repeat": _whole,
    "controller": _one_of(CONTROLLERS),
    "visit_number": _whole,
    "visit_date": lambda value: date.fromisoformat(str(value)).isoformat(),
    "simulated": lambda value: True if value else None,
    "design": lambda value: value if value in DESIGNS else None,
    "level": _number,
    "seed": _whole,
    "lower_bound": _number,
    "latency_us": lambda value: {name: _number(value[name]) for name in ("n", "mean", "std", "median", "p99")},
}
