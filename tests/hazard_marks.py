"""A hazard of which tests ran and none passed fails the run: a skipped test shows no control."""

from __future__ import annotations

import pytest

_PROPERTY = "hazard"
_ran: dict[str, bool] = {}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Add the hazards of its test to each report, from the processes of pytest-xdist too."""
    for item in items:
        for mark in item.iter_markers("hazard"):
            item.user_properties.extend((_PROPERTY, number) for number in mark.args)


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Note which hazards a test has shown to be under control."""
    for name, number in report.user_properties:
        if name == _PROPERTY:
            passed = report.when == "call" and report.passed
            _ran[str(number)] = _ran.get(str(number), False) or passed


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail where a hazard's tests were all skipped."""
    if unshown() and not hasattr(session.config, "workerinput") and session.exitstatus == 0:
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> None:
    """Say which."""
    if unshown():
        terminalreporter.write_line(f"no test passed for the hazards {', '.join(unshown())} of docs/hazards.md", red=True)


def unshown() -> list[str]:
    """List hazards of which tests ran, and none passed."""
    return sorted(number for number, passed in _ran.items() if not passed)
