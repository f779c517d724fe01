"""API types of signatures, of whatever is signed."""

from __future__ import annotations

from datetime import datetime

from pydantic import Field

from app.platform.web.schemas import Model, Text


class Signing(Model):
    """Credentials of a signer, who proves their identity again."""

    password: Text = Field(max_length=1000, description="The signer's own, asked for again.")
    code: Text = Field("", max_length=40, description="Of the signer's second factor, or a recovery code; empty where there is none.")


class SignatureOut(Model):
    """Signature: its signer, time and meaning."""

    signer: str
    signed_at: datetime
    meaning: str
    sha256: str = Field(description="Of the canonical JSON of all that was signed.")
