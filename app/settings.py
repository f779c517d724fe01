"""Settings of an installation, read from the environment (prefix BETALOOP_) or a .env file."""

from __future__ import annotations

import secrets
from functools import lru_cache
from pathlib import Path

from pydantic import Field
from pydantic_settings import BaseSettings, SettingsConfigDict


class Settings(BaseSettings):
    """One installation; every field is an environment variable, e.g. BETALOOP_DATA_DIR."""

    model_config = SettingsConfigDict(env_prefix="BETALOOP_", env_file=".env", extra="ignore")

    data_dir: Path = Field(Path("var"), description="Folder of the embedded database, stored files and job folders.")
    database_url: str | None = Field(None, description="PostgreSQL URL; without one an embedded PostgreSQL runs in the data folder.")
    host: str = Field("127.0.0.1", description="Address the web service listens on.")
    port: int = Field(8000, description="Port the web service listens on.")
    upload_limit_mb: int = Field(2048, ge=1, description="Largest accepted upload, MiB.")
    session_idle_minutes: int = Field(60, ge=1, description="A browser session ends after this many idle minutes.")
    session_max_hours: int = Field(12, ge=1, description="A browser session ends after this many hours in any case.")
    cookie_secure: bool = Field(False, description="Send the session cookie over HTTPS only; switch on behind TLS.")
    worker_slots: int = Field(2, ge=1, description="Compute steps that one worker runs side by side.")
    job_memory_mb: int = Field(8192, ge=512, description="Memory limit of one compute step, MiB.")
    log_level: str = Field("INFO", description="DEBUG, INFO, WARNING or ERROR.")
    log_json: bool = Field(False, description="Log lines as JSON.")

    @property
    def files_dir(self) -> Path:
        """Content-addressed store of uploads, snapshots and policies."""
        return self.data_dir / "files"

    @property
    def jobs_dir(self) -> Path:
        """Working folders of compute steps: parameters, checkpoints, results."""
        return self.data_dir / "jobs"

    def secret(self, name: str) -> bytes:
        """A random key of this installation, made at first use and kept in the data folder, readable by the owner only."""
        path = self.data_dir / "secrets" / name
        if not path.exists():
            path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
            draft = path.with_name(f"{name}.{secrets.token_hex(4)}")
            draft.touch(mode=0o600)
            draft.write_text(secrets.token_hex(32))
            try:
                # a hard link fails when another process made the key first, so that all processes agree on one
                path.hardlink_to(draft)
            except FileExistsError:
                pass
            finally:
                draft.unlink()
        return bytes.fromhex(path.read_text())


@lru_cache(maxsize=1)
def get_settings() -> Settings:
    """The settings of this process."""
    return Settings()
