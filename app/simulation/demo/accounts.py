"""The demo's people: their addresses and roles, and the one password that all of them have."""

from __future__ import annotations

import secrets
from pathlib import Path
from typing import Final

from app.accounts import repository
from app.accounts import service as accounts
from app.platform.database import transaction
from app.settings import written_once
from app.tables.accounts import Role

ADMIN, CLINICIAN, ENGINEER = "admin@demo.example", "clinician@demo.example", "engineer@demo.example"
ACCOUNTS: Final = {ADMIN: Role.ADMIN, CLINICIAN: Role.CLINICIAN, ENGINEER: Role.ENGINEER}


def password(data_dir: Path) -> str:
    """Return the demo's password, random and kept in the data folder."""
    return written_once(data_dir / "secrets" / "demo-password", lambda: f"beta-{secrets.token_hex(4)}")


def add_accounts(data_dir: Path) -> str:
    """Make the accounts that are missing; returns their password."""
    word = password(data_dir)
    with transaction("demo") as db:
        for email, role in ACCOUNTS.items():
            if repository.user_by_email(db, email) is None:
                accounts.add_user(db, email, role, word)
    return word
