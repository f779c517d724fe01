"""The programs of the embedded PostgreSQL, from a wheel that the server's user cannot enter."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import pytest

from app.platform.embedded import place, programs
from app.platform.embedded.programs import Programs, runnable
from app.platform.embedded.system_user import SystemUser, system_user
from app.settings import get_settings
from tests.app.platform.embedded.test_first_start import at_once
from tests.system_users import require_root


@pytest.fixture
def user() -> SystemUser:
    require_root("only root runs programs as another user")
    return system_user(get_settings().server_user)


@pytest.fixture
def open_folder(monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A folder that every user may enter; in place of `/var/lib/betaloop`."""
    folder = Path("/tmp") / f"betaloop-programs-{os.getpid()}-{os.urandom(4).hex()}"
    folder.mkdir()
    folder.chmod(0o755)
    monkeypatch.setattr(place, "SYSTEM_FOLDER", folder / "system")
    yield folder
    shutil.rmtree(folder)


@pytest.fixture
def wheel(open_folder: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The programs' folder of a wheel that was installed below a closed home, under a closed umask."""
    real = programs.wheel_programs()
    package = real.parents[1]
    site = open_folder / "home" / "site-packages"
    for part in (real.parent, package.with_name(f"{package.name}.libs")):
        shutil.copytree(part, site / part.relative_to(package.parent), symlinks=True)
    subprocess.run(["chmod", "-R", "go-rwx", str(open_folder / "home")], check=True)
    found = site / real.relative_to(package.parent)
    monkeypatch.setattr(programs, "wheel_programs", lambda: found)
    return found


def copies(open_folder: Path) -> list[Path]:
    return sorted((open_folder / "system").glob("programs-*"))


def test_programs_in_an_open_folder_are_used_where_they_are(user: SystemUser, open_folder: Path, wheel: Path) -> None:
    subprocess.run(["chmod", "-R", "go+rX", str(open_folder / "home")], check=True)
    assert runnable(user) == Programs(wheel, user)
    assert not copies(open_folder)


def test_many_first_starts_copy_a_closed_wheel_once_and_it_runs(user: SystemUser, open_folder: Path, wheel: Path) -> None:
    code = (
        "import pathlib; from app.platform.embedded import place, programs\n"
        "from app.platform.embedded.system_user import system_user\n"
        f"place.SYSTEM_FOLDER = pathlib.Path({str(place.SYSTEM_FOLDER)!r})\n"
        f"programs.wheel_programs = lambda: pathlib.Path({str(wheel)!r})\n"
        f"print(programs.runnable(system_user({user.name!r})).folder, flush=True)"
    )
    found = {Path(line) for line in at_once(code, [""] * 4)}
    assert len(found) == 1
    (copy,) = copies(open_folder)
    assert found.pop().is_relative_to(copy)
    again = runnable(user)
    for program in ("postgres", "initdb", "psql"):  # the last two need libpq, which is outside the folder of programs
        done = again.run(program, "--version")
        assert done.returncode == 0, done.stdout
        assert "PostgreSQL" in done.stdout
    assert copies(open_folder) == [copy]


@pytest.mark.parametrize("damage", ["libraries", "a file", "rights"])
def test_a_broken_copy_is_replaced(user: SystemUser, open_folder: Path, wheel: Path, damage: str) -> None:
    copy = runnable(user)
    (folder,) = copies(open_folder)
    if damage == "libraries":
        for libraries in folder.glob("*.libs"):
            shutil.rmtree(libraries)
    elif damage == "a file":
        next(copy.folder.parent.rglob("postgres.bki")).write_text("cut short")
    else:
        folder.chmod(0o700)
    assert runnable(user) == copy
    assert copy.fault() is None
    assert next(copy.folder.parent.rglob("postgres.bki")).stat().st_size > 1000
    assert copies(open_folder) == [folder]


def test_copies_of_packages_that_are_gone_are_removed_unless_they_run(user: SystemUser, open_folder: Path, wheel: Path) -> None:
    system = open_folder / "system"
    for left in ("programs-0123456789ab/bin", "programs-draft-x/pginstall/bin"):  # of earlier versions, and of a killed start
        (system / left).mkdir(parents=True)
    runnable(user)
    (first,) = copies(open_folder)
    os.utime(wheel / "postgres", (1, 1))  # the package was replaced
    shutil.copy("/bin/sleep", first / "sleep")
    with subprocess.Popen([first / "sleep", "60"]) as running:
        runnable(user)
        assert first in copies(open_folder)
        assert len(copies(open_folder)) == 2
        running.kill()
    runnable(user)
    assert len(copies(open_folder)) == 1
    assert not first.exists()


def test_programs_that_run_nowhere_are_explained(user: SystemUser, wheel: Path, open_folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (wheel / "initdb").write_bytes(b"no program")
    with pytest.raises(RuntimeError, match=rf"'{user.name}' cannot run PostgreSQL's programs: .*BETALOOP_DATABASE_URL"):
        runnable(user)
    assert not copies(open_folder)
    with pytest.raises(RuntimeError, match=r"This user cannot run PostgreSQL's programs"):
        runnable(None)


def test_a_path_that_a_shell_would_change_is_not_used(tmp_path: Path) -> None:
    assert "holds one of the characters" in str(Programs(tmp_path / "costs $HOME" / "bin", None).fault())
