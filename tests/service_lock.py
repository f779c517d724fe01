"""Which of the pinned packages the service itself needs, without those of tests and benchmarks: `make lock` writes them for the image."""

from __future__ import annotations

import re
from collections.abc import Iterator
from importlib.metadata import PackageNotFoundError, requires
from pathlib import Path

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

ROOT = Path(__file__).resolve().parents[1]
EXTRAS = ("", "nwb")


def pinned() -> dict[str, str]:
    """Line of `requirements.lock` by the name of the package."""
    lines = (ROOT / "requirements.lock").read_text().splitlines()
    return {canonicalize_name(re.split(r"[=@ \[]", line)[0]): line for line in lines if line and line[0] not in "#-"}


def needed(name: str = "betaloop", extras: tuple[str, ...] = EXTRAS, seen: set[tuple[str, tuple[str, ...]]] | None = None) -> Iterator[str]:
    """Names of the packages that a package needs on this platform, and of what those need."""
    seen = set() if seen is None else seen
    try:
        wanted = [Requirement(text) for text in requires(name) or ()]
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


def service_lock() -> str:
    """The text of `requirements-service.lock`."""
    lines = pinned()
    # what builds the package is part of the image, for it is installed there without the build's isolation
    names = sorted({*needed(), "setuptools"} & set(lines))
    return "".join(f"{lines[name]}\n" for name in names)


if __name__ == "__main__":
    (ROOT / "requirements-service.lock").write_text(service_lock())
