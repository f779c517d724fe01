"""Processes of compute steps: what they keep of a call, and what the process that forks them loads for all."""

from __future__ import annotations

import os
import signal
import time
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import psutil
import pytest

from app.platform.jobs.children.child import FULL_DISK, ChildLimits, params_hash
from app.platform.jobs.children.forked import ForkedProcesses
from app.platform.jobs.children.supervisor import ComputeCall
from tests.app.platform.upkeep.small_disks import small_disk


def test_a_result_is_reused_for_equal_params_and_the_folder_emptied_for_others(kinds, tmp_path):
    children, workdir = ForkedProcesses(learns=True), tmp_path / "step"

    def run(**params):
        call = ComputeCall(
            "count", "sample_job_kinds:count", {"part": 0, "numbers": 2, "pause_s": 0.0, **params}, workdir, ChildLimits(1024)
        )
        return children.run(call, lambda messages: None, lambda: None)["result"]

    first = run()
    assert run() == first
    assert params_hash("count", {"a": 1, "b": 2}) == params_hash("count", {"b": 2, "a": 1})
    other = run(numbers=3)
    assert (other["counted"], other["resumed_from"]) == (3, 0)
    assert other["pid"] != first["pid"]
    children.close()


@pytest.mark.parametrize("fails", ["", "yes"])
def test_the_module_of_a_step_is_imported_and_prepared_once_for_all_its_children(kinds, tmp_path, monkeypatch, fails):
    monkeypatch.setenv("TEST_PREPARE_FAILS", fails)
    children = ForkedProcesses(learns=True, niceness=3)

    def run(number, niceness):
        call = ComputeCall("who", "sample_job_kinds:who_prepared", {}, tmp_path / str(number), ChildLimits(1024, niceness=niceness))
        return children.run(call, lambda messages: None, lambda: None)["result"]

    try:
        each = [run(1, 3), run(2, 5), run(3, 0)]
        assert [one["prepared"] for one in each] == [[children.server_pid]] * 3
        assert {one["forked_by"] for one in each} == {children.server_pid}
        ours = os.nice(0)
        assert [one["nice"] for one in each] == [min(ours + n, 19) for n in (3, 5, 3)], "the server's step back is not taken twice"
        os.kill(children.server_pid, signal.SIGKILL)
        again = run(4, 0)
        assert again["prepared"] == [again["forked_by"]] != each[0]["prepared"], "another server, which has prepared it itself"
    finally:
        children.close()


@pytest.mark.parametrize("quotes", [True, False])
def test_a_full_disk_is_told_from_a_fault_of_the_step(kinds, tmp_path, quotes):
    children = ForkedProcesses(learns=True)
    call = ComputeCall("fill", "sample_job_kinds:write_to_a_full_disk", {}, tmp_path / "step", ChildLimits(1024, quotes=quotes))
    outcome = children.run(call, lambda messages: None, lambda: None)
    children.close()
    assert (outcome["ok"], outcome["cause"], outcome["message"]) == (False, "full", FULL_DISK)
    assert "OSError" in outcome["log"]


def test_a_full_disk_is_told_where_there_is_no_room_to_write_that_down(kinds, tmp_path):
    children = ForkedProcesses(learns=True)
    with small_disk(tmp_path / "small", "128k") as disk:
        call = ComputeCall("fill", "sample_job_kinds:fill_the_disk", {"disk": str(disk)}, disk / "step", ChildLimits(1024))
        outcome = children.run(call, lambda messages: None, lambda: None)
        children.close()
    assert (outcome["ok"], outcome["cause"], outcome["message"]) == (False, "full", FULL_DISK)


def who(children: ForkedProcesses, folder: Path) -> int:
    """Process that forked the child of one call."""
    call = ComputeCall("who", "sample_job_kinds:who_prepared", {}, folder, ChildLimits(1024))
    outcome = children.run(call, lambda messages: None, lambda: None)
    assert outcome["ok"], outcome
    return int(outcome["result"]["forked_by"])


def wait_until_gone(pid: int) -> None:
    deadline = time.monotonic() + 90
    while psutil.pid_exists(pid):  # a zombie exists too
        assert time.monotonic() < deadline
        time.sleep(0.02)


def test_the_process_that_forks_ends_when_idle_and_the_next_call_starts_another(kinds, tmp_path):
    children = ForkedProcesses(learns=True, idle_s=0.5)
    try:
        first = who(children, tmp_path / "1")
        assert who(children, tmp_path / "2") == first == children.server_pid
        wait_until_gone(first)
        assert children.server_pid is None
        again = who(children, tmp_path / "3")
        assert again == children.server_pid != first
        wait_until_gone(again)
    finally:
        children.close()


def test_a_process_started_ahead_of_a_call_serves_it_and_ends_where_no_call_comes(kinds, tmp_path):
    children = ForkedProcesses(learns=True, idle_s=5.0)
    try:
        children.prepare()
        assert who(children, tmp_path / "1") == children.server_pid
    finally:
        children.close()
    children = ForkedProcesses(learns=True, idle_s=0.3)
    try:
        children.prepare()
        unused = children.server_pid
        assert unused is not None
        wait_until_gone(unused)
    finally:
        children.close()


def test_a_call_that_lasts_longer_than_the_idle_time_keeps_its_process(kinds, tmp_path):
    children = ForkedProcesses(learns=True, idle_s=0.2)
    params = {"part": 0, "numbers": 10, "pause_s": 0.15}
    try:
        call = ComputeCall("count", "sample_job_kinds:count", params, tmp_path / "long", ChildLimits(1024))
        outcome = children.run(call, lambda messages: None, lambda: None)
    finally:
        children.close()
    assert (outcome["ok"], outcome["result"]["counted"]) == (True, 10), outcome


def test_no_call_is_lost_where_calls_come_just_when_the_process_ends(kinds, tmp_path):
    children = ForkedProcesses(learns=True, idle_s=0.05)

    def calls(turn: int, thread: int) -> set[int]:
        servers = set()
        for number in range(6):
            servers.add(who(children, tmp_path / f"{turn}-{thread}-{number}"))  # a folder that is used twice gives its first answer
            time.sleep(0.02 * (number + thread))
        return servers

    servers: set[int] = set()
    try:
        for turn in range(20):  # on a busy machine the calls of a round may leave no pause
            with ThreadPoolExecutor(3) as pool:
                servers = servers.union(*pool.map(partial(calls, turn), range(3)))
            if len(servers) > 1:
                break
            time.sleep(0.3)
    finally:
        children.close()
    assert len(servers) > 1, "it ended between calls"
