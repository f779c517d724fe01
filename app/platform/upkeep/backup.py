"""Backup and restore of a whole installation: database, stored files and keys, sealed with a key that is stored elsewhere.

The database is dumped first, in one snapshot. Stored files are never changed, and only quarantined ones are removed. So every other file
that the dump names is there when the files are copied after it. Passwords of the embedded server stay out: a restored installation has its
own.
"""

from __future__ import annotations

import contextlib
import json
import os
import re
import secrets
import shutil
import subprocess
import tarfile
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import IO, Any

from sqlalchemy import Engine, func, inspect, make_url, select, table, text

from app import __version__
from app.platform import files
from app.platform.audit.chain import seal
from app.platform.bucket import bucket
from app.platform.database import get_engine, now, owner_url, transaction
from app.platform.embedded.programs import wheel_programs
from app.platform.errors import BetaloopError
from app.platform.upkeep.migrate import migrate
from app.platform.upkeep.sealing import CHUNK, KEY_BYTES, SealedReader, SealedWriter
from app.settings import get_settings, private_folder

DATABASE, FILES, KEYS, MANIFEST = "database.sealed", "files.sealed", "keys.sealed", "manifest.json"
FORM = 1
SERVER_PASSWORDS = ("database", "database-admin", "database-service")
_SETTING = re.compile(rb"SET (\w+) = ")


class BackupError(BetaloopError):
    """A backup cannot be made or restored."""

    title = "The backup cannot be made or restored"


@dataclass(frozen=True)
class Restored:
    """Result of a restore.

    Attributes:
        tables: rows by table. files: stored files, each with its hash checked. made_at: when the backup was made, ISO 8601.
        damaged: hashes of stored files that were missing or damaged already when the backup was made.
    """

    tables: dict[str, int]
    files: int
    made_at: str
    damaged: list[str]


def make_key(path: Path) -> None:
    """Write a new random key, readable by its owner alone. Raises BackupError where the file exists."""
    try:
        with open(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL, 0o600), "w") as out:
            out.write(secrets.token_hex(KEY_BYTES) + "\n")
    except FileExistsError as error:
        raise BackupError(
            f"{path} exists already.", "A key that is overwritten opens no older backup any more. Name another file."
        ) from error


def read_key(path: Path, *apart_from: Path) -> bytes:
    """Read the key of a file.

    Raises:
        BackupError: there is none, it has no key, or it is in the data folder or next to the backup.
    """
    for folder in apart_from:
        if path.resolve().is_relative_to(folder.resolve()):
            raise BackupError(f"The key {path} is in {folder}, next to what it protects.", "Keep it on another medium.")
    try:
        key = bytes.fromhex(path.read_text().strip())
    except (OSError, ValueError, UnicodeDecodeError):
        key = b""
    if len(key) != KEY_BYTES:
        raise BackupError(f"{path} holds no key of {KEY_BYTES} bytes in hexadecimal.", "Make one with `betaloop backup-key FILE`.")
    return key


def backup(folder: Path, key_file: Path) -> dict[str, Any]:
    """Make a backup in a new folder and return its manifest; a backup that was cut off has no manifest.

    A stored file that is missing or damaged is named in the manifest (`damaged`) and omitted; all else is backed up. So is one that a
    person removed for good during the backup (`removed`), as they may a quarantined one.

    Raises:
        BackupError: the folder exists, the key cannot be used, or the database cannot be dumped.
    """
    settings = get_settings()
    key = read_key(key_file, settings.data_dir, folder)
    if folder.exists():
        raise BackupError(f"{folder} exists already.", "Name a new folder for each backup.")
    private_folder(folder)
    with get_engine().connect() as connection:
        revision = connection.scalar(text("select version_num from alembic_version"))
    manifest: dict[str, Any] = {"form": FORM, "betaloop": __version__, "made_at": now().isoformat(), "revision": revision, "parts": {}}
    with transaction("backup") as db:
        seal(db)
    before = _stored_hashes()
    with _sealing(folder / DATABASE, key) as out:
        _dump(out)
    names = sorted({*before, *_stored_hashes()})
    with _sealing(folder / FILES, key) as out, tarfile.open(fileobj=out, mode="w|") as archive:
        absent = [sha256 for sha256 in names if not _added(archive, sha256)]
    with _sealing(folder / KEYS, key) as out, tarfile.open(fileobj=out, mode="w|") as archive:
        for path in sorted((settings.data_dir / "secrets").glob("*")):
            if path.is_file() and path.name not in SERVER_PASSWORDS:
                archive.add(path, arcname=path.name, recursive=False)
    for name in (DATABASE, FILES, KEYS):
        sha256, size = files.hash_file(folder / name)
        manifest["parts"][name] = {"sha256": sha256, "bytes": size}
    manifest["files"], named = len(names) - len(absent), set(_stored_hashes())
    manifest |= {"damaged": [s for s in absent if s in named], "removed": [s for s in absent if s not in named]}
    draft = folder / f"{MANIFEST}.new"
    draft.write_text(json.dumps(manifest, indent=1) + "\n")
    draft.rename(folder / MANIFEST)
    return manifest


def restore(folder: Path, key_file: Path) -> Restored:
    """Bring a backup back into an empty installation, bring its database to the newest schema, and check every stored file.

    Raises:
        BackupError: the backup is incomplete or damaged, the installation is not empty, or rows lack their files.
    """
    manifest = verify(folder)
    settings = get_settings()
    key = read_key(key_file, settings.data_dir, folder)
    _require_empty(get_engine())
    _restore_keys(folder / KEYS, key)
    count = _restore_files(folder / FILES, key)
    with (folder / DATABASE).open("rb") as source:
        _load(SealedReader(source, key))
    migrate()
    damaged = manifest.get("damaged", [])
    known = {*damaged, *manifest.get("removed", [])}
    missing = [sha256 for sha256 in _stored_hashes() if sha256 not in known and not files.is_whole(sha256)]
    if missing:
        raise BackupError(f"{len(missing)} of the stored files are missing or damaged, the first {missing[0]}.", "Use another backup.")
    return Restored(_rows(get_engine()), count, manifest["made_at"], damaged)


def verify(folder: Path) -> dict[str, Any]:
    """Verify that the parts of a backup have their hashes, and return its manifest; needs no key.

    Raises:
        BackupError: it was cut off, parts are damaged, or a later betaloop made it.
    """
    try:
        manifest: dict[str, Any] = json.loads((folder / MANIFEST).read_text())
    except (OSError, ValueError) as error:
        raise BackupError(f"{folder} holds no complete backup: its {MANIFEST} is missing or damaged.", "Use another backup.") from error
    if manifest.get("form") != FORM:
        raise BackupError(
            f"This backup has form {manifest.get('form')}; this betaloop reads form {FORM}.", "Use the betaloop that made it."
        )
    for name, part in manifest["parts"].items():
        if not (folder / name).is_file() or files.hash_file(folder / name) != (part["sha256"], part["bytes"]):
            raise BackupError(
                f"{name} is missing or damaged: it does not have the hash of the manifest.", "Use another copy of the backup."
            )
    return manifest


def _added(archive: tarfile.TarFile, sha256: str) -> bool:
    """Add a stored file to the archive if it is whole; returns whether it is."""
    with files.borrowed(sha256) as path:
        if not files.whole_at(path, sha256):
            return False
        archive.add(path, arcname=sha256, recursive=False)
    return True


@contextmanager
def _sealing(path: Path, key: bytes) -> Iterator[SealedWriter]:
    with path.open("wb") as out:
        writer = SealedWriter(out, key)
        yield writer
        writer.close()
        out.flush()
        os.fsync(out.fileno())


def _program(name: str) -> str:
    """Find a PostgreSQL client program: the newer of the wheel's and the machine's, for an older one cannot read a newer server."""
    found = [str(wheel_programs() / name), shutil.which(name)]
    return max((p for p in found if p), key=_major_version)


def _major_version(program: str) -> int:
    said = subprocess.run([program, "--version"], capture_output=True, text=True, check=True).stdout
    number = re.search(r"(\d+)(\.|\D|$)", said.split(")")[-1])
    return int(number.group(1)) if number else 0


def _target() -> tuple[str, dict[str, str]]:
    """Return the address of the database for libpq, and the environment with its password, which must not be in a list of processes."""
    url = make_url(owner_url()).set(drivername="postgresql")
    password = {"PGPASSWORD": url.password} if isinstance(url.password, str) else {}
    return url.set(password=None).render_as_string(hide_password=False), os.environ | password


def _dump(out: SealedWriter) -> None:
    target, env = _target()
    command = [_program("pg_dump"), "--format=custom", "--compress=6", "--no-owner", "--no-privileges", f"--dbname={target}"]
    with tempfile.TemporaryFile() as said, subprocess.Popen(command, stdout=subprocess.PIPE, stderr=said, env=env) as process:
        assert process.stdout is not None
        shutil.copyfileobj(process.stdout, out, CHUNK)
        process.wait()
        _require(process, said, "dumped")


def _load(source: SealedReader) -> None:
    """Load an archive through SQL into psql in one transaction, without the settings that an older server does not have.

    psql commits at the end of its input. So it sees an end only when the archive was read whole; else it is killed and nothing is stored.
    """
    target, env = _target()
    unpack = [_program("pg_restore"), "--no-owner", "--no-privileges", "--file=-"]
    apply = [_program("psql"), "--no-psqlrc", "--quiet", "--set=ON_ERROR_STOP=1", "--single-transaction", f"--dbname={target}"]
    known = _server_settings(get_engine())
    with (
        tempfile.TemporaryFile() as said,
        subprocess.Popen(unpack, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=said) as unpacking,
        subprocess.Popen(apply, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL, stderr=said, env=env) as applying,
        ThreadPoolExecutor(max_workers=1) as pool,
    ):
        fed = pool.submit(_feed, source, unpacking)
        assert unpacking.stdout is not None
        assert applying.stdin is not None
        try:
            for line in _for_server(unpacking.stdout, known):
                applying.stdin.write(line)
            if unpacking.wait() == 0:
                applying.stdin.close()
            else:
                _give_up(applying)
        except BrokenPipeError:  # psql ended early: its exit code and words say why
            _give_up(applying)
            unpacking.kill()
        applying.wait()
        unpacking.wait()
        fed.result()
        _require(applying, said, "restored")
        _require(unpacking, said, "restored")


def _feed(source: SealedReader, process: subprocess.Popen[bytes]) -> None:
    """Hand the archive on. Raises NotOpened where it is damaged; the process is killed then, and sees no end of it."""
    assert process.stdin is not None
    try:
        shutil.copyfileobj(source, process.stdin, CHUNK)
        process.stdin.close()
    except BrokenPipeError:  # it ended early: its exit code says so
        _give_up(process)
    except BaseException:
        _give_up(process)
        raise


def _give_up(process: subprocess.Popen[bytes]) -> None:
    """End a process that must not take what it was given so far for all of it."""
    process.kill()
    assert process.stdin is not None
    with contextlib.suppress(BrokenPipeError):  # what is still buffered has nowhere to go
        process.stdin.close()


def _server_settings(engine: Engine) -> frozenset[str]:
    with engine.connect() as connection:
        return frozenset(connection.scalars(text("select name from pg_settings")))


def _for_server(sql: Iterator[bytes], known: frozenset[str]) -> Iterator[bytes]:
    """Filter the lines of a dump: settings that the server does not have are dropped. Settings come before the first rows."""
    for line in sql:
        setting = _SETTING.match(line)
        if setting is None or setting[1].decode() in known:
            yield line
        if line.startswith(b"COPY "):
            break
    yield from sql


def _require(process: subprocess.Popen[bytes], said: IO[bytes], done: str) -> None:
    if process.returncode != 0:
        said.seek(0)
        lines = said.read().decode(errors="replace").strip().splitlines()
        raise BackupError(f"The database cannot be {done}: {lines[-1] if lines else f'exit code {process.returncode}'}.")


def _require_empty(engine: Engine) -> None:
    tables = inspect(engine).get_table_names()
    held = get_settings().files_dir
    store = bucket()
    if tables or (held.is_dir() and any(p for p in held.iterdir() if p.name != "incoming")) or (store is not None and not store.empty()):
        raise BackupError(
            "This installation holds data already.",
            "Restore into a new data folder and, with a PostgreSQL or a bucket of your own, an empty database and prefix.",
        )


def _restore_keys(path: Path, key: bytes) -> None:
    folder = private_folder(get_settings().data_dir / "secrets")
    with path.open("rb") as source, tarfile.open(fileobj=SealedReader(source, key), mode="r|") as archive:
        for member in archive:
            target = folder / Path(member.name).name
            content = _content(archive, member)
            if target.exists() and target.read_bytes() != content:
                raise BackupError(
                    f"The key {target.name} of this installation differs from the backup's.", "Restore into a new data folder."
                )
            with open(os.open(target, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600), "wb") as out:
                out.write(content)


def _restore_files(path: Path, key: bytes) -> int:
    count = 0
    with path.open("rb") as source, tarfile.open(fileobj=SealedReader(source, key), mode="r|") as archive:
        for member in archive:
            extracted = archive.extractfile(member)
            if extracted is None:
                continue
            draft = files.draft_path()
            with draft.open("wb") as out:
                shutil.copyfileobj(extracted, out, CHUNK)
            if files.keep(draft, copy=False) != member.name:
                raise BackupError(f"The stored file {member.name} is damaged in the backup.", "Use another backup.")
            count += 1
    return count


def _content(archive: tarfile.TarFile, member: tarfile.TarInfo) -> bytes:
    extracted = archive.extractfile(member)
    return extracted.read() if extracted is not None else b""


def _stored_hashes() -> list[str]:
    with get_engine().connect() as connection:
        return list(connection.scalars(text("select sha256 from stored_file order by sha256")))


def _rows(engine: Engine) -> dict[str, int]:
    with engine.connect() as connection:
        counts = {}
        for name in sorted(inspect(engine).get_table_names()):
            counts[name] = connection.scalar(select(func.count()).select_from(table(name))) or 0
        return counts
