"""One-time codes by time (RFC 6238) with the settings of every authenticator app: SHA-1, six digits, steps of 30 s."""

from __future__ import annotations

import base64
import hmac
import secrets

import pyotp

STEP_S = 30
SECRET_BYTES = 20
_DRIFT_STEPS = 1
"""Steps by which a phone's clock may be off."""


def new_secret() -> bytes:
    """Draw a random secret."""
    return secrets.token_bytes(SECRET_BYTES)


def code_of(secret: bytes, step: int) -> str:
    """Compute the code of a time step."""
    return _codes(secret).generate_otp(step)


def step_at(unix_s: float) -> int:
    """Compute the time step of a moment."""
    return int(unix_s // STEP_S)


def matching_step(secret: bytes, code: str, unix_s: float, after: int = -1) -> int | None:
    """Find the time step of a code. Steps up to `after` are excluded, so that no code works twice; None where it fits no other."""
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
    return _codes(secret).provisioning_uri(name=email, issuer_name="betaloop")


def _codes(secret: bytes) -> pyotp.TOTP:
    return pyotp.TOTP(base32(secret), interval=STEP_S)
