"""Settings of an installation, read from the environment (prefix BETALOOP_) or a .env file."""

from __future__ import annotations

import os
import secrets
from collections.abc import Callable
from functools import lru_cache
from pathlib import Path

from pydantic import Field, SecretStr
from pydantic_settings import BaseSettings, SettingsConfigDict


class Settings(BaseSettings):
    """One installation; every field is an environment variable, e.g. BETALOOP_DATA_DIR."""

    model_config = SettingsConfigDict(env_prefix="BETALOOP_", env_file=".env", extra="ignore")

    data_dir: Path = Field(Path("var"), description="Folder of the embedded database, stored files and job folders.")
    database_url: str | None = Field(
        None,
        description="PostgreSQL URL, several hosts as HOST:PORT,HOST:PORT; without one an embedded PostgreSQL runs in the data folder.",
    )
    owner_url: str | None = Field(
        None, description="PostgreSQL URL of the role that owns the tables, for migrate, backup and restore; database_url's by default."
    )
    server_user: str = Field(
        "pgserver", description="System user of the embedded PostgreSQL where root starts betaloop; made at the first start."
    )
    host: str = Field("127.0.0.1", description="Address the web service listens on.")
    port: int = Field(8000, description="Port the web service listens on.")
    upload_limit_mb: int = Field(2048, ge=1, description="Largest accepted upload, MiB.")
    upload_gib_per_hour: float = Field(
        50.0, gt=0, description="Files that one network address, and one user, may send within an hour, GiB; by each web process."
    )
    failed_sign_ins_per_source: int = Field(
        100, ge=5, description="Failed sign-ins of one network address within 15 minutes, whatever the accounts; by each web process."
    )
    session_idle_minutes: int = Field(60, ge=1, description="A browser session ends after this many idle minutes.")
    session_max_hours: int = Field(12, ge=1, description="A browser session ends after this many hours in any case.")
    metrics_on_loopback: bool = Field(
        False, description="Answer /metrics without a token to programs of this machine; not where a proxy runs next to the service."
    )
    require_released_policies: bool = Field(
        False, description="Approve plans only of policies that a clinician has released, with a signature of its own."
    )
    outcomes: Path | None = Field(
        None, description="YAML file of the outcomes that this installation adds to those of the paper (docs/ingest/outcomes.md)."
    )
    cookie_secure: bool = Field(
        False,
        description="Send the session cookie over HTTPS only; on with TLS, and where other machines reach the service unless set to false.",
    )
    public_url: str | None = Field(None, description="Address at which browsers reach this service; needed for a sign-on.")
    oidc_issuer: str | None = Field(
        None, description="Address of a hospital's identity provider (OpenID Connect); without one there is no sign-on."
    )
    oidc_client_id: str | None = Field(None, description="Name of this service at the provider.")
    oidc_client_secret: SecretStr | None = Field(None, description="Its secret there; none for a public client.")
    oidc_claim: str = Field(
        "email", description="Claim that names a user's address here; `email` counts only where the provider says that it is verified."
    )
    oidc_name: str = Field("Hospital sign-on", description="What the sign-on is called on pages.")
    worker_slots: int = Field(2, ge=1, description="Compute steps that one worker runs side by side.")
    job_memory_mb: int = Field(8192, ge=512, description="Memory limit of one compute step, MiB.")
    job_niceness: int = Field(
        15,
        ge=0,
        le=19,
        description="How far compute steps step back behind all else on the machine: 0 not at all, 19 furthest.",
    )
    decode_slots: int = Field(2, ge=1, description="Uploaded files that one process has read side by side.")
    decode_memory_mb: int = Field(2048, ge=512, description="Memory limit of reading one uploaded file, MiB.")
    decode_seconds: int = Field(180, ge=5, description="Processor time that reading one uploaded file may take, s.")
    log_level: str = Field("INFO", description="DEBUG, INFO, WARNING or ERROR.")
    development: bool = Field(False, description="Show pages for those who build on betaloop, such as /styleguide.")
    demo: bool = Field(False, description="Say on the first page that this is the demo, and where to begin; `betaloop demo` sets it.")
    log_json: bool = Field(False, description="Log lines as JSON.")

    files_url: str | None = Field(
        None,
        description="Bucket of the stored files, s3://BUCKET/PREFIX, for all machines; without one they lie in the data folder.",
    )
    files_endpoint: str | None = Field(None, description="Address of the bucket's server, where it is not Amazon's.")
    files_cache_gib: float = Field(20.0, gt=0, description="Room for copies of the bucket's files on this machine, GiB.")

    @property
    def files_dir(self) -> Path:
        """Content-addressed store of uploads, snapshots and policies; with a bucket, this machine's copies of it."""
        return self.data_dir / "files"

    @property
    def jobs_dir(self) -> Path:
        """Working folders of compute steps: parameters, checkpoints, results."""
        return self.data_dir / "jobs"

    def secret(self, name: str) -> bytes:
        """Return a random key of this installation, made at first use and stored in the data folder, readable by the owner only."""
        return stored_secret(self.data_dir / "secrets", name)


def stored_secret(folder: Path, name: str) -> bytes:
    """Return a random key of 32 bytes in a folder of secrets; made at first use, also when several processes ask at once.

    Raises:
        RuntimeError: the file does not hold such a key.
    """
    text = written_once(folder / name, lambda: secrets.token_hex(32))
    try:
        key = bytes.fromhex(text)
    except ValueError:
        key = b""
    if len(key) != 32:
        raise RuntimeError(f"{folder / name} does not hold a key of 32 bytes in hexadecimal. Restore it from a backup of the data folder.")
    return key


def written_once(path: Path, make: Callable[[], str]) -> str:
    """Return the text of a file that only its owner reads. The first process writes it, all others read the same."""
    if not path.exists():
        private_folder(path.parent)
        draft = path.with_name(f"{path.name}.{secrets.token_hex(4)}")
        with open(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as out:
            out.write(make())
            out.flush()
            os.fsync(out.fileno())
        try:
            # a hard link fails when another process was first, so that all processes agree on one text
            path.hardlink_to(draft)
        except FileExistsError:
            pass
        finally:
            draft.unlink()
    return path.read_text()


def private_folder(path: Path) -> Path:
    """Make a folder that only its owner may enter, and return it; one that is open to others is closed."""
    path.mkdir(parents=True, exist_ok=True, mode=0o700)
    info = path.stat()
    if info.st_mode & 0o077 and info.st_uid == os.geteuid():
        path.chmod(0o700)
    return path


@lru_cache(maxsize=1)
def get_settings() -> Settings:
    """Return the settings of this process."""
    return Settings()
