"""Blinded bundle, whose files do not reveal what it runs: one sealed file of one size, with sheet, runner and a manifest without names."""

from __future__ import annotations

from dataclasses import dataclass, replace

from ml.deploy import bundle as bundles
from ml.deploy.manifest import BundleError, BundleManifest
from ml.deploy.runtime.slot import SEALED, seal

_NEEDED = (bundles.MANIFEST, bundles.VECTORS)
_ROOM = 2**18
"""The least that a sealed file takes, bytes: more than any schedule with its test vectors."""
BLINDED = "blinded"
"""In the place of the controller's name."""


@dataclass(frozen=True)
class Common:
    """Values that all sessions of a blinded plan share, and that may be read: limits in mA and mA/s, window, period in s."""

    min_ma: float
    max_ma: float
    ramp_ma_per_s: float
    window: int
    period_s: float


def room_for(largest_network: int) -> int:
    """Compute the size in bytes of the sealed file of every session of a plan, given the size of its largest ONNX file."""
    room = _ROOM
    while room < largest_network + _ROOM // 2:
        room *= 2
    return room


def blind(content: bytes, common: Common, nonce: str, room: int) -> bytes:
    """Blind a bundle, unsigned: move all that reveals its controller into one sealed file.

    Args:
        content: of a bundle of a blinded session. nonce: 32 hexadecimal digits. room: bytes of the sealed file.

    Raises:
        BundleError: it is no intact bundle, or not one of a blinded session.
    """
    bundles.verify_bundle(content)
    files = bundles.unpack(content)
    inner = BundleManifest.from_bytes(files[bundles.MANIFEST])
    if inner.card is None or inner.slot is None or not inner.card.blinded:
        raise BundleError("only the bundle of a blinded session is sealed")
    network = [name for name in (bundles.WEIGHTS, bundles.MODEL) if name in files][:1]  # the layers say all that the ONNX file does
    sealed = seal({name: files[name] for name in (*_NEEDED, *network)}, nonce, room)
    outer = BundleManifest(
        participant=inner.participant,
        policy_id=None,
        policy_name=inner.card.head,
        hemisphere=inner.hemisphere,
        window=common.window,
        period_s=common.period_s,
        beta_unit=inner.beta_unit,
        beta_source=inner.beta_source,
        min_ma=common.min_ma,
        max_ma=common.max_ma,
        cdbs_ma=inner.cdbs_ma,
        ramp_ma_per_s=common.ramp_ma_per_s,
        limits_stated_by=inner.limits_stated_by,
        code_version=inner.code_version,
        taken_by=inner.taken_by,
        public_key=inner.public_key,
        slot=replace(inner.slot, controller=BLINDED, repeat=1),
        card=inner.card,
        approvals=inner.approvals,
        sealed=nonce,
    )
    open_files = {name: files[name] for name in (bundles.SHEET, *bundles.RUNNER)}
    return bundles.pack_whole(outer, open_files | {SEALED: sealed})
