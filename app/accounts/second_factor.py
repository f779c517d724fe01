"""The optional second factor: codes of an authenticator app, and recovery codes that work once each. The caller commits.

The secret is stored encrypted, and recovery codes are hashed. The key is in the data folder, so that a copy of the database alone gives
none.
"""

from __future__ import annotations

import base64
import hashlib
import hmac
import secrets
from datetime import UTC, datetime

import pyotp
from cryptography.hazmat.primitives.ciphers.aead import AESGCM
from sqlalchemy.orm import Session

from app.platform.database import now
from app.platform.errors import Conflict, Invalid
from app.settings import get_settings
from app.tables.accounts import SecondFactor, User

# One-time codes by time (RFC 6238) with the settings of every authenticator app: SHA-1, six digits, steps of 30 s.

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


RECOVERY_CODES = 10
_NONCE_BYTES = 12


def begin(db: Session, user: User) -> bytes:
    """Give a user a new secret, which counts once a code of it was given (`confirm`); one that was not confirmed is replaced.

    Raises:
        Conflict: the user has a second factor.
    """
    row = db.get(SecondFactor, user.id)
    if row is not None and row.confirmed_at is not None:
        raise Conflict("You have a second factor already.", "Remove it first to set up another.")
    secret = new_secret()
    if row is None:
        db.add(SecondFactor(user_id=user.id, sealed_secret=_seal(secret, user.id), recovery=[]))
    else:
        row.sealed_secret = _seal(secret, user.id)
    db.flush()
    return secret


def pending_secret(db: Session, user_id: int) -> bytes | None:
    """Return the secret of a set-up that was begun and not confirmed."""
    row = db.get(SecondFactor, user_id)
    return _secret(row) if row is not None and row.confirmed_at is None else None


def confirm(db: Session, user: User, code: str) -> list[str]:
    """Confirm the second factor, which counts from now on; returns the recovery codes, which are shown this once.

    Raises:
        Invalid: nothing was begun, or the code is wrong.
    """
    row = _locked(db, user.id)
    if row is None or row.confirmed_at is not None:
        raise Invalid("No second factor is being set up.", "Begin again.")
    if not _takes_code(row, code):
        raise Invalid("The code is wrong.", "Give the one that the app shows now; both clocks must be right.", field="code")
    codes = [f"{secrets.token_hex(3)}-{secrets.token_hex(3)}" for _ in range(RECOVERY_CODES)]
    row.recovery = [_hash(c) for c in codes]
    row.confirmed_at = now()
    db.flush()
    return codes


def wanted(db: Session, user_id: int) -> bool:
    """Decide whether a user must give a code besides the password."""
    row = db.get(SecondFactor, user_id)
    return row is not None and row.confirmed_at is not None


def accepts(db: Session, user_id: int, code: str) -> bool:
    """Accept a code, or a recovery code, if it is right; it works this once. True where the user has no second factor."""
    row = _locked(db, user_id)
    if row is None or row.confirmed_at is None:
        return True
    if _takes_code(row, code):
        return True
    hashed = _hash(code.strip().lower())
    if hashed not in row.recovery:
        return False
    row.recovery = [r for r in row.recovery if r != hashed]
    return True


def remove(db: Session, user_id: int) -> bool:
    """Take the second factor away; whether there was one."""
    row = db.get(SecondFactor, user_id)
    if row is not None:
        db.delete(row)
        db.flush()
    return row is not None


def recovery_codes_left(db: Session, user_id: int) -> int:
    """Count the recovery codes that still work."""
    row = db.get(SecondFactor, user_id)
    return len(row.recovery) if row is not None else 0


def _locked(db: Session, user_id: int) -> SecondFactor | None:
    """Lock the row until the transaction ends: of two requests with one code at once, one is accepted."""
    return db.get(SecondFactor, user_id, with_for_update=True, populate_existing=True)


def _takes_code(row: SecondFactor, code: str) -> bool:
    used = -1 if row.last_used_at is None else step_at(row.last_used_at.timestamp())
    step = matching_step(_secret(row), code, now().timestamp(), used)
    if step is None:
        return False
    row.last_used_at = datetime.fromtimestamp(step * STEP_S, UTC)
    return True


def _seal(secret: bytes, user_id: int) -> bytes:
    nonce = secrets.token_bytes(_NONCE_BYTES)
    return nonce + AESGCM(_key()).encrypt(nonce, secret, str(user_id).encode())


def _secret(row: SecondFactor) -> bytes:
    sealed = bytes(row.sealed_secret)
    return AESGCM(_key()).decrypt(sealed[:_NONCE_BYTES], sealed[_NONCE_BYTES:], str(row.user_id).encode())


def _key() -> bytes:
    return get_settings().secret("second-factor")


def _hash(code: str) -> str:
    # keyed: short enough to be typed, codes could be guessed from plain hashes
    return hmac.digest(_key(), code.encode(), hashlib.sha256).hex()
