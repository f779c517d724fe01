"""Reports of progress; every fit, training and roll-out takes a `Report`."""

from __future__ import annotations

from typing import Protocol


class Report(Protocol):
    """Called now and then with the finished share and a few named numbers (losses, estimates)."""

    def __call__(self, fraction: float, message: str = "", **numbers: float) -> None:
        """Report a `fraction` in [0, 1]; `message` is a short phrase for a person; `numbers` become points of learning curves."""


def silent(fraction: float, message: str = "", **numbers: float) -> None:
    """Ignore a report."""


def part_of(report: Report, k: int, of: int) -> Report:
    """Report the k-th of several equal parts of a computation."""

    def inner(fraction: float, message: str = "", **numbers: float) -> None:
        report((k + fraction) / of, message, **numbers)

    return inner
