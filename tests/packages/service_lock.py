"""Pinned packages that the service itself needs, without those of tests and benchmarks: `make lock` writes them for the image."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterator, Mapping
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[2]
LOCK = ROOT / "requirements-service.lock"
EXTRAS = ("", "nwb", "recordings", "s3")


def pinned() -> dict[str, str]:
    """Return the line of `requirements.lock` by the name of the package."""
    lines = (ROOT / "requirements.lock").read_text().splitlines()
    return {canonicalize_name(re.split(r"[=@ \[]", line)[0]): line for line in lines if line and line[0] not in "#-"}


def _wanted(name: str) -> list[str]:
    """List what a package requires; betaloop itself by its `pyproject.toml`, for what is installed may be of another day."""
    if name != "betaloop":
        return requires(name) or []
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = {extra: project["optional-dependencies"][extra] for extra in EXTRAS if extra}
    return [*project["dependencies"], *(text for of in extras.values() for text in of)]


def needed(name: str = "betaloop", extras: tuple[str, ...] = EXTRAS, seen: set[tuple[str, tuple[str, ...]]] | None = None) -> Iterator[str]:
    """Yield names of the packages that a package needs on this platform, and of what those need."""
    seen = set() if seen is None else seen
    try:
        wanted = [Requirement(text) for text in _wanted(name)]
    except PackageNotFoundError:
        return
    for one in wanted:
        if one.marker is not None and not any(one.marker.evaluate({"extra": extra}) for extra in (*extras, "")):
            continue
        key = (canonicalize_name(one.name), tuple(sorted(one.extras)))
        if key not in seen and key[0] != "betaloop":
            seen.add(key)
            yield key[0]
            yield from needed(one.name, key[1], seen)


def service_packages() -> list[str]:
    """List the lines `name==version` of what the image holds."""
    lines = pinned()
    # what builds the package is part of the image, for it is installed there without the build's isolation
    names = sorted({*needed(), "setuptools"} & set(lines))
    return [lines[name] + ("+cpu" if name == "torch" else "") for name in names]


def held() -> dict[str, list[str]]:
    """Return hashes by line `name==version` of `requirements-service.lock`."""
    text = LOCK.read_text().replace("\\\n", " ")
    return {
        line.split()[0]: re.findall(r"--hash=(sha256:[0-9a-f]{64})", line) for line in text.splitlines() if line and line[0] not in "#-"
    }


def hashes(packages: list[str]) -> dict[str, str]:
    """Return the SHA-256 of the file that pip installs for each package, from pip's package indexes without installing anything."""
    with tempfile.TemporaryDirectory() as folder:
        wanted, report = Path(folder, "wanted.txt"), Path(folder, "report.json")
        wanted.write_text("\n".join(packages))
        call = ["install", "--dry-run", "--quiet", "--no-deps", "--ignore-installed", "--only-binary=:all:"]
        call += ["--report", str(report), "-r", str(wanted)]
        subprocess.run([sys.executable, "-m", "pip", "--disable-pip-version-check", *call], check=True)
        return {
            _line(found): found["download_info"]["archive_info"]["hashes"]["sha256"] for found in json.loads(report.read_text())["install"]
        }


def _line(found: dict[str, Any]) -> str:
    return _normal(f"{found['metadata']['name']}=={found['metadata']['version']}")


def _normal(line: str) -> str:
    name, _, version = line.partition("==")
    return f"{canonicalize_name(name)}=={version}"


def service_lock(known: Mapping[str, str]) -> str:
    """Write the text of `requirements-service.lock`."""
    head = (
        "# Written by `make lock` for the image: Linux on x86-64, Python 3.11."
        " The index that PIP_EXTRA_INDEX_URL names has torch without CUDA.\n"
    )
    return head + "".join(f"{line} \\\n    --hash=sha256:{known[_normal(line)]}\n" for line in service_packages())


if __name__ == "__main__":
    LOCK.write_text(service_lock(hashes(service_packages())))
