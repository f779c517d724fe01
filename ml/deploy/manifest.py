"""What a controller bundle says about itself: whose policy, which signal, which limits, which files, who approved."""

from __future__ import annotations

import json
import math
import re
from dataclasses import MISSING, asdict, dataclass, field, fields
from typing import Any

from ml.deploy.envelope import EnvelopeLimits

SCHEMA_VERSION = 1
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
class BundleManifest:
    """The contents of `manifest.json`.

    Attributes:
        participant: the participant's code.
        policy_id, policy_name: as the study knows the policy.
        window: W, beta amplitudes per decision, oldest first.
        period_s: m, seconds per decision.
        beta_unit, beta_source: of the beta amplitudes that the network takes.
        normalisation_mean, normalisation_std: z-scoring constants inside the network; None where the file does not show them.
        min_ma, max_ma, cdbs_ma, ramp_ma_per_s: the clinician's limits, as in `EnvelopeLimits`.
        max_beta_age_s, fallback_ramp_ma_per_s: as in `EnvelopeLimits`.
        snapshot_sha256: of the buffer snapshot that the policy was trained on; None for a policy made elsewhere.
        code_version: of the betaloop that made the bundle.
        approvals: sign-offs, in order.
        files: SHA-256 by file name of everything else in the bundle; filled in when the bundle is built.
        schema_version: of this manifest.

    Raises:
        BundleError: a value is missing or outside its range.
    """

    participant: str
    policy_id: int
    policy_name: str
    window: int
    beta_unit: str
    beta_source: str
    min_ma: float
    max_ma: float
    cdbs_ma: float
    ramp_ma_per_s: float
    code_version: str
    period_s: float = 2.0
    normalisation_mean: float | None = None
    normalisation_std: float | None = None
    max_beta_age_s: float | None = None
    fallback_ramp_ma_per_s: float | None = None
    snapshot_sha256: str | None = None
    approvals: tuple[Approval, ...] = ()
    files: dict[str, str] = field(default_factory=dict)
    schema_version: int = SCHEMA_VERSION

    def __post_init__(self) -> None:
        if self.schema_version != SCHEMA_VERSION:
            raise BundleError(f"this bundle has manifest version {self.schema_version}; this betaloop reads {SCHEMA_VERSION}")
        for name in ("participant", "policy_name", "beta_unit", "beta_source", "code_version"):
            if not getattr(self, name).strip():
                raise BundleError(f"the manifest needs a {name}")
        for name, digest in [("snapshot_sha256", self.snapshot_sha256), *self.files.items()]:
            if digest is not None and not _SHA256.fullmatch(digest):
                raise BundleError(f"the SHA-256 of {name} must be 64 hexadecimal digits, not '{digest}'")
        scale = (self.normalisation_mean, self.normalisation_std)
        if any(v is not None for v in scale) and not all(v is not None and math.isfinite(v) for v in scale):
            raise BundleError(f"normalisation needs a finite mean and standard deviation, or neither, not {scale}")
        self.limits()

    def limits(self) -> EnvelopeLimits:
        """The limits for the safety envelope. Raises BundleError where they contradict each other."""
        names = [f.name for f in fields(EnvelopeLimits)]
        try:
            return EnvelopeLimits(**{name: getattr(self, name) for name in names})
        except ValueError as error:
            raise BundleError(f"the limits in the manifest cannot be used: {error}") from error

    def to_bytes(self) -> bytes:
        """The manifest as JSON; the same manifest always gives the same bytes."""
        return (json.dumps(asdict(self), sort_keys=True, indent=2, ensure_ascii=False, allow_nan=False) + "\n").encode()

    @staticmethod
    def from_bytes(content: bytes) -> BundleManifest:
        """The inverse of `to_bytes`. Raises BundleError naming what is missing, unknown or of the wrong type."""
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
        return BundleManifest(**values, approvals=tuple(Approval(**item) for item in approvals))


_TEXT, _WHOLE, _NUMBER = (str,), (int,), (int, float)
_TYPES: dict[str, tuple[type, ...]] = {
    "str": _TEXT,
    "int": _WHOLE,
    "float": _NUMBER,
    "float | None": (*_NUMBER, type(None)),
    "str | None": (*_TEXT, type(None)),
    "dict[str, str]": (dict,),
}


def _check_keys(where: str, kind: type[Any], values: dict[str, Any]) -> None:
    """Names and JSON types of an object against a dataclass of simple fields."""
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
        if isinstance(value, dict) and not all(isinstance(text, str) for text in value.values()):
            raise BundleError(f"{name} in {where} must map names to text")
