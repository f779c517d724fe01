"""Kill -9 of web, worker, compute child and postmaster at random moments, under uploads, QoCs, clinic day, training and evaluation.

    python benchmarks/soak.py                              50 rounds, 14 minutes at most
    python benchmarks/soak.py --quick                      8 rounds, 3 minutes where the machine has nothing else to do
    python benchmarks/soak.py --rounds 12 --minutes 6      as many as fit, and each kind of process once
    python benchmarks/soak.py --webs 2 --workers 3 --own   on the machine's own PostgreSQL (Debian's), one of them killed in each round

Of an installation of its own, in a new folder. Webs and workers are started again as soon as they were killed, as a service manager
does, and so is a PostgreSQL of one's own; a child and the postmaster of the embedded PostgreSQL are left to betaloop. Healthy means:
`/readyz` answers 200 (web, postmaster), a worker has given a sign of life since (worker, postmaster), a compute step has a process
again or no step waits for one (child): within 10 s each time on a machine that has nothing else to do, and as many times as long as
others take its processors (`longest_share` is the longest time as a share of that).

A caller may be cut off and may meet 503 or 507, but no other server error. At the end, every write that was acknowledged must be there
once, every job must have ended once, `betaloop doctor --hashes` and `betaloop
audit verify` must find nothing, and a stop must leave no process. Exit code 1, with what is wrong, where not. Whatever is waited for has a
time, and who waits longer says for what.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import signal
import sys
import time
from collections import defaultdict
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import psutil
from installed.installation import STARTED_S, Installation, TooLate, installation, times_slower, utc
from installed.writers import PEOPLE, Study, Writers, live_jobs, make_study, what_is_wrong
from support.results import run_benchmark

KINDS = ("web", "worker", "child", "postmaster")
HEALTHY_S = 10.0
"""Whatever was killed, on a machine that has nothing else to do; as many times as long where others wait for the processors too."""
OWN_LOAD = 2.5
"""Load that a run makes by itself (docs/reliability.md)."""
PATIENCE_S = 120.0
"""Time after which an unhealthy installation ends the run."""
ORPHANS_S = 5.0
JOBS_S = 90.0
"""For so long the last jobs may show no progress; a busy machine makes them slow, and does not stop them."""
LAST_JOBS_S = 600.0
"""By then they must have ended, whatever their progress."""
BETWEEN_S = (1.0, 5.0)


@dataclass
class Soak:
    """One run.

    Attributes:
        times: seconds until healthy, by what was killed. cpu: of these, the processor time of a web or worker that was started again.
        shares: the same times as shares of what they may be at the load of their moment.
        late: sentences about those that are not below 1.
    """

    installed: Installation
    writers: Writers
    begun: float
    times: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    cpu: dict[str, list[float]] = field(default_factory=lambda: defaultdict(list))
    shares: list[float] = field(default_factory=list)
    late: list[str] = field(default_factory=list)

    def say(self, text: str) -> None:
        """Print a line with the seconds since the begin."""
        print(f"{time.monotonic() - self.begun:7.1f} s  {text}", flush=True)

    def round(self, number: int, of: int, kind: str) -> None:
        """Kill one process and wait until all is healthy. Raises TooLate."""
        killed: Callable[[], tuple[str, float]] = getattr(self, f"_{kind}")
        what, seconds = killed()
        if seconds >= 0:
            self.took(kind, seconds, os.getloadavg()[0])
        healthy = f"healthy after {seconds:.2f} s" if seconds >= 0 else ""
        self.say(f"round {number}/{of}: {what} {healthy}  ({self.writers.said} acknowledged)")

    def took(self, kind: str, seconds: float, load: float) -> None:
        """Keep how long it took until all was healthy after a process of a kind was killed, at the load of the last minute."""
        self.times[kind].append(seconds)
        self.shares.append(seconds / (HEALTHY_S * times_slower(load, OWN_LOAD)))
        if self.shares[-1] >= 1:
            self.late.append(f"healthy {seconds:.1f} s after a {kind} was killed, at a load of {load:.1f}: the aim is {HEALTHY_S:.0f} s")

    def _web(self) -> tuple[str, float]:
        web = random.choice(self.installed.webs)
        ready = lambda: self.installed.is_ready(web)  # noqa: E731
        return f"{web} killed,", self._kill_process(web, ready, f"{web} to answer /readyz with 200")

    def _worker(self) -> tuple[str, float]:
        since, worker = utc(), random.choice(self.installed.workers)
        alive = lambda: self.installed.lives_since(worker, since)  # noqa: E731
        return f"{worker} killed,", self._kill_process(worker, alive, f"a sign of life of the new {worker}")

    def _kill_process(self, name: str, healthy: Callable[[], bool], what: str) -> float:
        process = self.installed.processes[name]
        # the postmaster is a child by birth of the process that started it, and goes on
        below = [p for p in psutil.Process(process.pid).children(recursive=True) if not _is_postgres(p)]
        killed = time.monotonic()
        os.kill(process.pid, signal.SIGKILL)
        process.wait()
        self.installed.start(name)
        self.installed.wait_until(f"{what}, after the old one was killed", healthy, PATIENCE_S)
        seconds = time.monotonic() - killed
        used = psutil.Process(self.installed.processes[name].pid).cpu_times()
        self.cpu[name.split()[0]].append(used.user + used.system)
        self.installed.wait_until(f"the end of the children of the killed {name}", lambda: not any(map(_runs, below)), ORPHANS_S)
        return seconds

    def _child(self) -> tuple[str, float]:
        found = [child for name in self.installed.processes for child in self.installed.children(name)]
        if not found:
            return "no child computed, so none was killed;", -1.0
        child = random.choice(found)
        killed = time.monotonic()
        try:
            if not (folder := _folder(child)):
                return "the child had not begun, and was not killed;", -1.0
            child.kill()
        except psutil.Error:
            return "the child ended before it was killed;", -1.0
        if "/jobs/" not in folder:  # an upload, which its sender sends again
            self.installed.wait_until("every web to answer after a reader of uploads was killed", self.installed.webs_are_ready, PATIENCE_S)
            return "reader of an upload killed,", time.monotonic() - killed
        job, step = folder.split("/")[-2:]
        running = "select 1 from job_step where job_id = %s and replace(key, '/', '__') = %s and status = 'running'"
        what = f"step {step} to have a process again after its child was killed"
        healthy = lambda: self._computes(folder, child.pid) or self.installed.ask(running, job, step) == []  # noqa: E731
        self.installed.wait_until(what, healthy, PATIENCE_S)
        return f"child of step {step} killed,", time.monotonic() - killed

    def _computes(self, folder: str, other_than: int) -> bool:
        """Decide whether a step has a process other than a killed one."""
        for child in (c for worker in self.installed.workers for c in self.installed.children(worker)):
            with contextlib.suppress(psutil.Error):
                if child.pid != other_than and _folder(child) == folder:
                    return True
        return False

    def _postmaster(self) -> tuple[str, float]:
        since, killed = utc(), time.monotonic()
        os.kill(self.installed.database.pid(), signal.SIGKILL)
        if self.installed.own:
            self.installed.own.start()
        what = "every web to answer /readyz with 200 after the postmaster was killed"
        self.installed.wait_until(what, self.installed.webs_are_ready, PATIENCE_S)
        web = time.monotonic() - killed
        alive = lambda: self.installed.workers_live_since(since)  # noqa: E731
        self.installed.wait_until("a sign of life of every worker after the postmaster was killed", alive, PATIENCE_S)
        return f"postmaster killed (web {web:.2f} s),", time.monotonic() - killed


def soak(installed: Installation, rounds: int, minutes: float, seed: int) -> dict[str, float]:
    """Run once; return the figures of the last line.

    Raises:
        TooLate: something did not happen in its time. RuntimeError: something acknowledged is lost or doubled; a request met a server
            error; a process is left; something was not healthy in time.
    """
    begun = time.monotonic()
    random.seed(seed)
    run, study = _begun(installed, begun)
    first = time.monotonic()
    done = _rounds(run, rounds, first + 36 * minutes)  # the rest of the time is for the jobs to end
    run.writers.stop_jobs()
    run.say("no more jobs are begun")
    _wait_for_jobs(installed)
    run.writers.stop()
    run.say(f"writers have stopped: {run.writers.said}; answers {dict(run.writers.said.answers)}")
    wrong = run.late + what_is_wrong(installed, run.writers.said, study)
    run.say(f"jobs: {dict(installed.ask('select status, count(*) from job group by 1') or [])}")
    for kind, error in installed.ask("select kind, error from job where status = 'failed'") or []:
        run.say(f"  {kind} failed: {error}")
    installed.stop()
    orphans = _left_after_the_stop(installed)
    run.say(f"stopped; left behind: {orphans or 'nothing'}")
    wrong += [f"a process is left: {one}" for one in orphans]
    for command in (["doctor", "--hashes"], ["audit", "verify"]):
        found = installed.run(*command)
        run.say(f"betaloop {' '.join(command)}: exit code {found.returncode}")
        if found.returncode:
            wrong.append(f"betaloop {' '.join(command)} finds: {found.stdout}{found.stderr}")
    figures = report(run, done)
    if wrong:
        raise RuntimeError(f"{len(wrong)} things are wrong:\n" + "\n".join(wrong[:40]) + f"\n{installed.said()}")
    return figures


def _begun(installed: Installation, begun: float) -> tuple[Soak, Study]:
    """Start an installation with a study that is written to."""
    tokens = installed.add_people(PEOPLE)
    made = time.monotonic()
    for web in installed.webs:
        installed.start(web)
    first = installed.wait_until("the first answer of every web", installed.webs_are_ready, STARTED_S)
    study = make_study(installed, tokens)
    writers = Writers(installed, tokens[next(iter(PEOPLE))], study)
    run = Soak(installed, writers, begun)
    run.say(f"database made in {made - begun:.1f} s, web ready {first:.1f} s after its start, study made; load {os.getloadavg()[0]:.1f}")
    since = utc()
    for worker in installed.workers:
        installed.start(worker)
    installed.wait_until("the first sign of life of every worker", lambda: installed.workers_live_since(since), STARTED_S)
    writers.start()
    return run, study


def _rounds(run: Soak, rounds: int, until: float) -> int:
    """Kill something in each round, every kind equally often, in random order, each once at least; how many rounds there was time for."""
    kinds: list[str] = []
    while len(kinds) < rounds:
        kinds += random.sample(KINDS, len(KINDS))
    for number, kind in enumerate(kinds[:rounds], start=1):
        if time.monotonic() > until and number > len(KINDS):
            run.say(f"no time for more than {number - 1} of {rounds} rounds")
            return number - 1
        time.sleep(random.uniform(*BETWEEN_S))
        run.round(number, rounds, kind)
    return rounds


def report(run: Soak, rounds: int) -> dict[str, float]:
    """Print the whole distribution of times until healthy, and return its figures."""
    every = sorted(s for found in run.times.values() for s in found)
    for kind in KINDS:
        found = sorted(run.times[kind])
        used = f"; of its own processor time: {' '.join(f'{s:.2f}' for s in sorted(run.cpu[kind]))}" if run.cpu[kind] else ""
        print(f"{kind:<11}{len(found):>3}  healthy after s: {' '.join(f'{s:.2f}' for s in found)}{used}")
    middle = every[len(every) // 2] if every else float("nan")
    figures = {"rounds": rounds, "kills": len(every), "median_s": round(middle, 2), "longest_s": round(max(every, default=0.0), 2)}
    return figures | {
        "over_10_s": sum(s >= HEALTHY_S for s in every),
        "longest_share": round(max(run.shares, default=0.0), 2),
        "acknowledged": _acknowledged(run),
        "seconds": round(time.monotonic() - run.begun, 1),
        "load": round(os.getloadavg()[1], 1),  # of the last five minutes: about as long as a short run
    }


def _acknowledged(run: Soak) -> int:
    said = run.writers.said
    return len(said.uploads) + len(said.qocs) + len(said.entries) + len(said.jobs)


def _wait_for_jobs(installed: Installation) -> None:
    """Wait for the end of every job, as long as they go on. Raises TooLate with those that do not."""
    before, moved, latest = live_jobs(installed), time.monotonic(), time.monotonic() + LAST_JOBS_S
    while before != []:
        time.sleep(0.5)
        present, now = live_jobs(installed), time.monotonic()
        if present is not None and present != before:
            before, moved = present, now
        elif now - moved > JOBS_S or now > latest:
            listed = "\n".join(before or ["the database does not answer"])
            raise TooLate(
                f"jobs have not ended, and show nothing new since {now - moved:.0f} s (id, kind, status, message, executor, its status):\n"
                f"{listed}\n{installed.said()}"
            )


def _left_after_the_stop(installed: Installation) -> list[str]:
    try:
        installed.wait_until("the end of every process of the installation", lambda: not installed.left(), ORPHANS_S)
    except TooLate:
        return installed.left()
    return []


def _folder(child: psutil.Process) -> str:
    """Find the folder of the step that a child computes, which it has locked; empty where it has not begun."""
    return next((str(Path(held.path).parent) for held in child.open_files() if held.path.endswith("/.lock")), "")


def _is_postgres(process: psutil.Process) -> bool:
    try:
        return bool(process.name().startswith(("postgres", "pg_ctl")))
    except psutil.Error:
        return False


def _runs(process: psutil.Process) -> bool:
    try:
        return bool(process.is_running() and process.status() != psutil.STATUS_ZOMBIE)
    except psutil.Error:
        return False


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="8 rounds, 2 minutes for them and the end of the jobs")
    parser.add_argument("--rounds", type=int, default=50)
    parser.add_argument("--minutes", type=float, default=14.0, help="for rounds and the end of the jobs, where each kind was killed once")
    parser.add_argument("--seed", type=int, default=0, help="of what is killed when")
    parser.add_argument("--webs", type=int, default=1)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--own", action="store_true", help="on the machine's own PostgreSQL")
    parser.add_argument("--keep", action="store_true", help="keep the folder of the installation")
    options = parser.parse_args()
    rounds, minutes = (8, 2.0) if options.quick else (options.rounds, options.minutes)
    try:
        with installation(options.webs, options.workers, options.own, options.keep) as installed:
            figures = soak(installed, rounds, minutes, options.seed)
    except RuntimeError as wrong:
        print(f"soak: {wrong}", file=sys.stderr)
        sys.exit(1)
    print(json.dumps(figures))


if __name__ == "__main__":
    run_benchmark(main)
