"""Small file systems in memory, for tests of what happens on a disk that is really full."""

from __future__ import annotations

import os
import shutil
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import pytest


@contextmanager
def small_disk(place: Path, size: str, mode: str = "0711") -> Iterator[Path]:
    """Mount a file system of this size (as `mount` takes it: `24m`) at a new folder; both go at the end, whatever still uses them.

    Skips the test where mounting is not allowed.
    """
    if os.geteuid() != 0:
        pytest.skip("only root may mount a file system")
    if shutil.which("mount") is None:
        pytest.skip("this machine has no `mount`")
    place.mkdir()
    done = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={size},mode={mode}", "tmpfs", str(place)], capture_output=True, text=True, check=False
    )
    try:
        if done.returncode:
            pytest.skip(f"no file system can be mounted here: {done.stderr.strip()}")
        try:
            yield place
        finally:
            subprocess.run(["umount", "--lazy", str(place)], check=True)
    finally:
        place.rmdir()


def grow(disk: Path, size: str) -> None:
    """Give a small disk another size."""
    subprocess.run(["mount", "-o", f"remount,size={size}", str(disk)], check=True)


def fill(disk: Path) -> None:
    """Leave not a byte of room."""
    with (disk / "filler").open("ab", buffering=0) as out:
        for size in (1 << 20, 1 << 12, 1):
            with suppress(OSError):
                while out.write(bytes(size)) == size:
                    pass
    assert shutil.disk_usage(disk).free == 0


def make_room(disk: Path) -> None:
    """Take away what filled it, where something does."""
    (disk / "filler").unlink(missing_ok=True)
