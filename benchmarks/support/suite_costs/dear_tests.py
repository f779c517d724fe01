"""Cost of each test in processor seconds: a plugin that `benchmarks/suite.py` gives to pytest.

Counted are the process of the tests, what it started, and the servers that it started and that went on without it (PostgreSQL's). Those are
children of the benchmark, which adopts what lost its parent; their environment names whose they are. What a test shares with later ones,
such as a server or a template, is counted to the first that asks for it.
"""

from __future__ import annotations

import json
import os
import resource
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import pytest

COSTS, ADOPTER, STARTER = "BETALOOP_SUITE_COSTS", "BETALOOP_SUITE_ADOPTER", "BETALOOP_SUITE_STARTER"
"""Environment: the folder where costs are written; the process that adopts what lost its parent; the process of the tests."""

os.environ[STARTER] = str(os.getpid())
_TICKS_PER_S = os.sysconf("SC_CLK_TCK")
_ours: dict[int, bool] = {}


def _is_ours(pid: int) -> bool:
    if pid not in _ours:
        try:
            _ours[pid] = f"{STARTER}={os.getpid()}".encode() in Path(f"/proc/{pid}/environ").read_bytes().split(b"\0")
        except OSError:  # it ended meanwhile
            return False
    return _ours[pid]


def _spent_s() -> float:
    """Sum the processor seconds so far of this process and of all that it started."""
    children, cost = defaultdict(list), {}
    for name in filter(str.isdigit, os.listdir("/proc")):
        try:
            fields = Path(f"/proc/{name}/stat").read_text().rpartition(")")[2].split()
        except OSError:  # it ended meanwhile
            continue
        children[int(fields[1])].append(int(name))
        cost[int(name)] = sum(map(int, fields[11:15])) / _TICKS_PER_S
    own = os.getpid()
    waiting = [*children[own], *(pid for pid in children[int(os.environ[ADOPTER])] if pid != own and _is_ours(pid))]
    spent = sum(getattr(resource.getrusage(who), kind) for who in (0, resource.RUSAGE_CHILDREN) for kind in ("ru_utime", "ru_stime"))
    while waiting:
        pid = waiting.pop()
        spent += cost[pid]
        waiting += children[pid]
    return float(spent)


_last = 0.0


def pytest_collection_finish() -> None:
    """Begin to count."""
    global _last
    _last = _spent_s()


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol(item: pytest.Item) -> Iterator[None]:
    """Write down what a test cost, from the end of the last one on."""
    global _last
    done = yield
    before, _last = _last, _spent_s()
    with Path(os.environ[COSTS], f"{os.getpid()}.jsonl").open("a") as file:
        file.write(json.dumps([item.nodeid, _last - before]) + "\n")
    return done
