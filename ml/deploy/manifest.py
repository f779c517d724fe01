"""Manifest of a controller bundle: whose policy, which signal, which limits, which files, who approved."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable
from dataclasses import MISSING, asdict, dataclass, field, fields
from itertools import pairwise
from typing import Any, TypeVar

from ml.deploy.runtime.envelope import EnvelopeLimits
from ml.deploy.runtime.network import OWN_OUTPUT, Output
from ml.deploy.runtime.schedule import Schedule
from ml.deploy.runtime.slot import Slot

SCHEMA_VERSION = 4
_SHA256 = re.compile(r"[0-9a-f]{64}")


class BundleError(ValueError):
    """The bytes are no intact controller bundle; the message names the part at fault."""


@dataclass(frozen=True, kw_only=True)
class Approval:
    """One sign-off.

    Attributes:
        name: who approved, as the study knows the person.
        role: in which role (`clinician`, `engineer`, ...).
        approved_at: ISO 8601 time with its offset.
        statement: what was approved.
    """

    name: str
    role: str
    approved_at: str
    statement: str


@dataclass(frozen=True, kw_only=True)
class PlanCard:
    """Text of the signed plan's sheet about the session that a bundle is for: the bundle's own sheet repeats it.

    Attributes:
        head, minutes: of its title line. lines: label and text, in order. warnings: a sentence each.
        stop_rules: those of the plan. blinded: whether only letters, the plan's common limits and the stop rules may be read.
    """

    head: str
    minutes: str
    lines: tuple[tuple[str, str], ...]
    warnings: tuple[str, ...]
    stop_rules: str
    blinded: bool = False

    @staticmethod
    def from_json(stored: dict[str, Any]) -> PlanCard:
        """Read a card from JSON. Raises TypeError, ValueError, KeyError for another shape."""
        lines = tuple((str(label), str(text)) for label, text in stored["lines"])
        return PlanCard(**stored | {"lines": lines, "warnings": tuple(map(str, stored["warnings"])), "blinded": stored["blinded"] is True})


@dataclass(frozen=True, kw_only=True)
class BundleManifest:
    """The contents of `manifest.json`.

    Attributes:
        participant: the participant's code.
        policy_id, policy_name: as the study knows the policy; without number, and with the design's name, where a schedule runs.
        hemisphere: `left` or `right`; None where the study states one amplitude for all.
        window: W, beta amplitudes per decision, oldest first.
        period_s: m, seconds per decision.
        beta_unit, beta_source: of the beta amplitudes that the network takes.
        beta_low_hz, beta_high_hz, min_valid_fraction: how they are made from local field potentials.
        normalisation_mean, normalisation_std: z-scoring constants inside the network; None where the file does not show them.
        min_ma, max_ma, cdbs_ma, ramp_ma_per_s: the clinician's limits, as in `EnvelopeLimits`.
        max_beta_age_s, beta_max, level_low, level_high, frozen_after, most_imputed, carried_over: as in `EnvelopeLimits`.
        limits_stated_by: who stated the limits, and when; None where they are defaults.
        device_min_ma, device_max_ma: amplitude limits read from the participant's stimulator; None where no recording has them.
        snapshot_sha256: of the buffer snapshot that the policy was trained on; None for a policy made elsewhere.
        policy_code_version: of the betaloop that trained the policy.
        code_version: of the betaloop that made the bundle.
        teacher_name: of the policy that this one was distilled from; None where it was not.
        agreement_mean, agreement_p99, agreement_worst: absolute difference of the fraction from the teacher's over the buffer's states.
        layers: units from the window to the output; empty where the network is no plain multi-layer perceptron.
        activations: of each hidden layer, `relu` or `tanh`.
        output_kind, output_gain, output_offset, output_low, output_high: what follows the last layer, as in `runtime.network.Output`.
        no_header: why there is neither C header nor reference runner; None where there are.
        test_windows_from: where the beta windows of the test vectors were logged; None where they are made up.
        test_windows: how many of them there are, before those at the edges.
        logged_lower_bound: B, lowest amplitude fraction that the study's random controller draws; None where not known.
        asked_mean: the mean fraction that the network requests over the logged test windows. asked_below_bound, asked_below_minimum: shares
            of windows with a request below B, and below the clinician's minimum.
        energy_of_cdbs, charge_of_cdbs: mean square and mean of the amplitude over cDBS, over the logged test windows and within limits.
        int8_bound, int8_planes, int8_bytes: of the fixed-point header; None where there is none.
        taken_by: who took the bundle first, and when; None for one made without a service.
        public_key: Ed25519 key that the bundle is signed with, 64 hexadecimal digits; it names the signer and proves nothing by itself.
        slot: the session of the signed plan that the bundle is for; None for one taken without a plan, which runs on the bench alone.
        schedule: what is delivered where no network decides; None where one does.
        card: what the plan's sheet says of that session; None without a plan, and in bundles made before it was taken along.
        approvals: sign-offs, in order.
        sealed: 32 hexadecimal digits by which what a blinded bundle keeps to itself is masked (`runtime.slot`); None where nothing is.
        files: SHA-256 by file name of everything else in the bundle; filled in when the bundle is built.
        schema_version: of this manifest.

    Raises:
        BundleError: a value is missing or outside its range.
    """

    participant: str
    policy_id: int | None
    policy_name: str
    window: int
    beta_unit: str
    beta_source: str
    min_ma: float
    max_ma: float
    cdbs_ma: float
    ramp_ma_per_s: float
    code_version: str
    policy_code_version: str = "unknown"
    period_s: float = 2.0
    hemisphere: str | None = None
    beta_low_hz: float = 13.0
    beta_high_hz: float = 35.0
    min_valid_fraction: float = 0.7
    normalisation_mean: float | None = None
    normalisation_std: float | None = None
    max_beta_age_s: float | None = None
    beta_max: float | None = None
    level_low: float | None = None
    level_high: float | None = None
    frozen_after: int | None = None
    most_imputed: int = 0
    carried_over: float = 1.0
    limits_stated_by: str | None = None
    device_min_ma: float | None = None
    device_max_ma: float | None = None
    snapshot_sha256: str | None = None
    teacher_name: str | None = None
    agreement_mean: float | None = None
    agreement_p99: float | None = None
    agreement_worst: float | None = None
    layers: tuple[int, ...] = ()
    activations: tuple[str, ...] = ()
    output_kind: str = OWN_OUTPUT.kind
    output_gain: float = OWN_OUTPUT.gain
    output_offset: float = OWN_OUTPUT.offset
    output_low: float | None = OWN_OUTPUT.low
    output_high: float | None = OWN_OUTPUT.high
    no_header: str | None = None
    test_windows_from: str | None = None
    test_windows: int = 0
    logged_lower_bound: float | None = None
    asked_mean: float | None = None
    asked_below_bound: float | None = None
    asked_below_minimum: float | None = None
    energy_of_cdbs: float | None = None
    charge_of_cdbs: float | None = None
    int8_bound: float | None = None
    int8_planes: int | None = None
    int8_bytes: int | None = None
    taken_by: str | None = None
    public_key: str | None = None
    slot: Slot | None = None
    schedule: Schedule | None = None
    card: PlanCard | None = None
    sealed: str | None = None
    approvals: tuple[Approval, ...] = ()
    files: dict[str, str] = field(default_factory=dict)
    schema_version: int = SCHEMA_VERSION

    @property
    def logged_bound_ma(self) -> float | None:
        """Lowest amplitude that random sessions tried, mA; None where not known."""
        return None if self.logged_lower_bound is None else self.logged_lower_bound * self.cdbs_ma

    def __post_init__(self) -> None:
        if self.schema_version != SCHEMA_VERSION:
            raise BundleError(f"this bundle has manifest version {self.schema_version}; this betaloop reads version {SCHEMA_VERSION}")
        self._check_kind()
        for name in ("participant", "policy_name", "beta_unit", "beta_source", "code_version", "policy_code_version"):
            if not getattr(self, name).strip():
                raise BundleError(f"the manifest needs a {name}")
        for name, digest in [("snapshot_sha256", self.snapshot_sha256), ("public_key", self.public_key), *self.files.items()]:
            if digest is not None and not _SHA256.fullmatch(digest):
                raise BundleError(f"the SHA-256 of {name} must be 64 hexadecimal digits, not '{digest}'")
        scale = (self.normalisation_mean, self.normalisation_std)
        if any(v is not None for v in scale) and not all(v is not None and math.isfinite(v) for v in scale):
            raise BundleError(f"normalisation needs a finite mean and standard deviation, or neither, not {scale}")
        if self.hemisphere not in (None, "left", "right"):
            raise BundleError(f"hemisphere must be left or right, not '{self.hemisphere}'")
        if not 0 < self.beta_low_hz < self.beta_high_hz or not 0 < self.min_valid_fraction <= 1:
            raise BundleError(f"the beta band {self.beta_low_hz} to {self.beta_high_hz} Hz or its valid share cannot be used")
        if self.layers and (min(self.layers) < 1 or self.layers[0] != self.window or self.layers[-1] != 1):
            raise BundleError(f"layers {list(self.layers)} do not lead from the window to one output")
        if len(self.activations) != max(0, len(self.layers) - 2):
            raise BundleError(f"layers {list(self.layers)} need {max(0, len(self.layers) - 2)} activations, not {list(self.activations)}")
        self.limits()
        self._check_device_limits()

    def _check_kind(self) -> None:
        """Check that a network or a schedule runs; the message does not report what is sealed."""
        if self.card is not None and self.slot is None:
            raise BundleError("a bundle without a slot has no card of a plan")
        if self.schedule is not None and (self.policy_id is not None or self.layers):
            raise BundleError("a bundle holds a network or a schedule, not both")
        if self.sealed is not None:
            self._check_sealed(self.sealed)
        elif self.schedule is None and self.policy_id is None:
            raise BundleError("the manifest needs a policy_id or a schedule")

    def _check_sealed(self, nonce: str) -> None:
        """Check that the manifest of a blinded bundle names its session, and nothing of its controller."""
        if not re.fullmatch(r"[0-9a-f]{32}", nonce):
            raise BundleError(f"sealed must be 32 hexadecimal digits, not '{nonce}'")
        if self.slot is None or self.card is None or not self.card.blinded:
            raise BundleError("only the bundle of a blinded session is sealed")
        if self.schedule is not None or self.policy_id is not None or self.layers:
            raise BundleError("a sealed bundle names neither network nor schedule")

    def _check_device_limits(self) -> None:
        """Check that the clinician's limits are within what the stimulator was set to allow."""
        if self.device_max_ma is not None and self.max_ma > self.device_max_ma + 1e-6:
            raise BundleError(f"the highest amplitude, {self.max_ma:g} mA, is above the stimulator's own limit, {self.device_max_ma:g} mA")
        if self.device_min_ma is not None and self.min_ma < self.device_min_ma - 1e-6:
            raise BundleError(f"the lowest amplitude, {self.min_ma:g} mA, is below the stimulator's own limit, {self.device_min_ma:g} mA")

    @property
    def macs(self) -> int:
        """Multiply-accumulate operations of one decision; 0 where the layers are not known."""
        return sum(i * o for i, o in pairwise(self.layers))

    @property
    def parameters(self) -> int:
        """Weights and biases; 0 where the layers are not known."""
        return sum(i * o + o for i, o in pairwise(self.layers))

    def limits(self) -> EnvelopeLimits:
        """Collect the limits for the safety envelope. Raises BundleError where they contradict each other."""
        names = [f.name for f in fields(EnvelopeLimits)]
        try:
            return EnvelopeLimits(**{name: getattr(self, name) for name in names})
        except ValueError as error:
            raise BundleError(f"the limits in the manifest cannot be used: {error}") from error

    def output(self) -> Output:
        """Describe what follows the last layer."""
        return Output(self.output_kind, self.output_gain, self.output_offset, self.output_low, self.output_high)

    def to_bytes(self) -> bytes:
        """Write the manifest as JSON; the same manifest always gives the same bytes."""
        return (json.dumps(asdict(self), sort_keys=True, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode()

    @staticmethod
    def from_bytes(content: bytes) -> BundleManifest:
        """Read what `to_bytes` wrote. Raises BundleError naming what is missing, unknown or of the wrong type."""
        try:
            values = json.loads(content)
        except ValueError as error:
            raise BundleError(f"manifest.json is no JSON: {error}") from error
        if not isinstance(values, dict):
            raise BundleError("manifest.json must hold one object")
        _check_keys("manifest.json", BundleManifest, values)
        approvals = values.pop("approvals", [])
        if not isinstance(approvals, list) or not all(isinstance(item, dict) for item in approvals):
            raise BundleError("approvals in manifest.json must be a list of objects")
        for item in approvals:
            _check_keys("an approval in manifest.json", Approval, item)
        layers = values.pop("layers", [])
        if not isinstance(layers, list) or not all(isinstance(units, int) and not isinstance(units, bool) for units in layers):
            raise BundleError("layers in manifest.json must be a list of whole numbers")
        activations = values.pop("activations", [])
        if not isinstance(activations, list) or not all(isinstance(name, str) for name in activations):
            raise BundleError("activations in manifest.json must be a list of names")
        signed = tuple(Approval(**item) for item in approvals)
        values["slot"] = _read_object("slot", values.get("slot"), lambda stored: Slot(**stored))
        values["schedule"] = _read_object("schedule", values.get("schedule"), Schedule.from_json)
        values["card"] = _read_object("card", values.get("card"), PlanCard.from_json)
        return BundleManifest(**values, layers=tuple(layers), activations=tuple(activations), approvals=signed)


Made = TypeVar("Made")


def _read_object(name: str, stored: Any, make: Callable[[dict[str, Any]], Made]) -> Made | None:
    """Read an object inside the manifest. Raises BundleError where it has another shape."""
    if stored is None:
        return None
    try:
        return make(stored)
    except (TypeError, ValueError, KeyError) as error:
        raise BundleError(f"{name} in manifest.json cannot be used: {error}") from error


_TEXT, _WHOLE, _NUMBER = (str,), (int,), (int, float)
_TYPES: dict[str, tuple[type, ...]] = {
    "str": _TEXT,
    "int": _WHOLE,
    "float": _NUMBER,
    "float | None": (*_NUMBER, type(None)),
    "str | None": (*_TEXT, type(None)),
    "int | None": (*_WHOLE, type(None)),
    "dict[str, str]": (dict,),
}


def _check_keys(where: str, kind: type[Any], values: dict[str, Any]) -> None:
    """Check names and JSON types of an object against a dataclass of simple fields."""
    known = {f.name: f for f in fields(kind)}
    unknown = sorted(set(values) - set(known))
    if unknown:
        raise BundleError(f"{where} has unknown entries: {', '.join(unknown)}")
    required = {name for name, f in known.items() if f.default is MISSING and f.default_factory is MISSING}
    missing = sorted(required - set(values))
    if missing:
        raise BundleError(f"{where} lacks {', '.join(missing)}")
    for name, value in values.items():
        allowed = _TYPES.get(str(known[name].type))
        if allowed and (not isinstance(value, allowed) or isinstance(value, bool)):
            raise BundleError(f"{name} in {where} must be {known[name].type}, not {json.dumps(value)}")
        if str(known[name].type) == "dict[str, str]" and not all(isinstance(text, str) for text in value.values()):
            raise BundleError(f"{name} in {where} must map names to text")
