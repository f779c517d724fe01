"""One-time codes by time: RFC 6238 over RFC 4226, with SHA-1, six digits and steps of 30 s, as every authenticator app has them."""

from __future__ import annotations

import base64
import hashlib
import hmac
import secrets
from urllib.parse import quote

STEP_S = 30
DIGITS = 6
SECRET_BYTES = 20
_DRIFT_STEPS = 1
"""A phone's clock may be so many steps off."""


def new_secret() -> bytes:
    """Draw a random secret."""
    return secrets.token_bytes(SECRET_BYTES)


def code_of(secret: bytes, step: int, digits: int = DIGITS) -> str:
    """Compute the code of a time step (RFC 4226, section 5.3)."""
    mac = hmac.new(secret, step.to_bytes(8, "big"), hashlib.sha1).digest()
    offset = mac[-1] & 0x0F
    return str((int.from_bytes(mac[offset : offset + 4], "big") & 0x7FFFFFFF) % 10**digits).zfill(digits)


def step_at(unix_s: float) -> int:
    """Compute the time step of a moment."""
    return int(unix_s // STEP_S)


def matching_step(secret: bytes, code: str, unix_s: float, after: int = -1) -> int | None:
    """Find the time step that a code belongs to, none at or before `after`, so that no code works twice; None where it fits none."""
    typed = "".join(code.split())
    found = None
    for step in range(step_at(unix_s) - _DRIFT_STEPS, step_at(unix_s) + _DRIFT_STEPS + 1):
        if step > after and hmac.compare_digest(code_of(secret, step).encode(), typed.encode()):
            found = step
    return found


def base32(secret: bytes) -> str:
    """Write the secret as an app takes it by hand."""
    return base64.b32encode(secret).decode().rstrip("=")


def address(secret: bytes, email: str) -> str:
    """Build the `otpauth` address that sets an app up."""
    return f"otpauth://totp/betaloop:{quote(email, safe='@')}?secret={base32(secret)}&issuer=betaloop&digits={DIGITS}&period={STEP_S}"
