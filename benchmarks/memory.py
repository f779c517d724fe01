"""Memory of an idle demo by process, and of another checkout.

    python benchmarks/memory.py [--quick] [--than /path/to/checkout]

A real `betaloop demo` in a new folder: its study is uploaded, its rankings are made, and when nothing has run for IDLE_S its processes are
measured. `--quick` cancels the rankings once the first training has begun, which loads what a worker ever loads for one.

PSS is the proportional set size: a page that n processes share counts 1/n in each, so that sums are true. Private pages are those that a
process alone has. Both are of /proc (Linux). PostgreSQL's processes are counted together. The last line is JSON.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path

import httpx2 as httpx
import psutil
from support.results import run_benchmark

from app.platform.embedded.server import EmbeddedPostgres
from app.settings import get_settings

ROOT = Path(__file__).resolve().parents[1]
IDLE_S = 150.0
"""Longer than any process waits for more work before it ends."""
PASSED_ON = ("BETALOOP_SERVER_USER", "BETALOOP_JOB_NICENESS", "BETALOOP_WORKER_SLOTS")
READY = "Ready."
STARTED_S, RANKED_S = 1800.0, 6 * 3600.0
ADMIN = "admin@demo.example"
MOST_MB = 650


@dataclass(frozen=True)
class Used:
    """Memory of one process, or of all of PostgreSQL's, MB (1e6 bytes)."""

    name: str
    pss_mb: float
    private_mb: float


@dataclass(frozen=True)
class Demo:
    """A running demo: its process, data folder and address."""

    process: psutil.Popen
    folder: Path
    base: str
    checkout: Path

    def command(self, *arguments: str) -> list[str]:
        """Name a command of betaloop."""
        own = self.checkout / ".venv" / "bin" / "python"
        return [str(own) if own.exists() else sys.executable, "-m", "app.cli", *arguments]

    def output(self) -> str:
        """Return what it printed so far."""
        return (self.folder / "said.txt").read_text(errors="replace")

    def loaded(self) -> bool:
        """Decide whether its study is uploaded and a ranking has been asked for."""
        with contextlib.suppress(FileNotFoundError):
            return bool(json.loads((self.folder / "demo.json").read_text())["jobs"])
        return False


def environment(folder: Path, checkout: Path) -> dict[str, str]:
    """Return the environment of a demo: its data folder, and of the caller's settings those of PASSED_ON alone."""
    kept = {k: v for k, v in os.environ.items() if not k.startswith("BETALOOP_") or k in PASSED_ON}
    return kept | {"BETALOOP_DATA_DIR": str(folder), "PYTHONPATH": str(checkout)}


@contextmanager
def demo(checkout: Path) -> Iterator[Demo]:
    """Run a demo; stop it at the end and remove its data."""
    with tempfile.TemporaryDirectory(prefix="betaloop-memory-", dir="/tmp", ignore_cleanup_errors=True) as name:
        folder = Path(name)
        folder.chmod(0o711)  # PostgreSQL runs as a user of its own where root starts it
        with socket.socket() as probe:
            probe.bind(("127.0.0.1", 0))
            port = probe.getsockname()[1]
        one = Demo(None, folder, f"http://127.0.0.1:{port}", checkout)
        with (folder / "said.txt").open("w") as out:
            process = psutil.Popen(
                one.command("demo", "--port", str(port)), cwd=checkout, env=environment(folder, checkout), stdout=out, stderr=out
            )
        try:
            yield Demo(process, folder, one.base, checkout)
        finally:
            process.send_signal(signal.SIGTERM)
            process.wait(120)
            EmbeddedPostgres(folder / "postgres", server_user=get_settings().server_user).remove()


def wait_for(one: Demo, what: str, condition: object, seconds: float) -> None:
    """Wait until a condition holds. Raises RuntimeError where the demo ends or it takes too long; the message has what the demo printed."""
    deadline = time.monotonic() + seconds
    while not condition():  # type: ignore[operator]
        if one.process.poll() is not None or time.monotonic() > deadline:
            raise RuntimeError(f"{what} did not come about:\n{one.output()[-3000:]}")
        time.sleep(1.0)


def finish_jobs(one: Demo, cancel: bool) -> None:
    """Wait until every ranking has ended; or cancel them once a training of the first reports progress."""
    done = subprocess.run(
        one.command("token", "create", ADMIN, "--name", "memory"), cwd=one.checkout, env=environment(one.folder, one.checkout),
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    token = done.stdout.split()[-1]
    with httpx.Client(base_url=f"{one.base}/api/v1", headers={"Authorization": f"Bearer {token}"}, timeout=120) as client:

        def ids() -> list[str]:
            return list(json.loads((one.folder / "demo.json").read_text())["jobs"].values())

        def job(number: str) -> dict[str, object]:
            found: dict[str, object] = client.get(f"/jobs/{number}").raise_for_status().json()
            return found

        def training() -> bool:
            return any(step["status"] == "running" and step["progress"] > 0.05 for step in job(ids()[0])["steps"])  # type: ignore[attr-defined]

        def ended() -> bool:
            states = {number: job(number)["status"] for number in ids()}
            left = [number for number, state in states.items() if state not in ("succeeded", "failed", "cancelled")]
            for number in left if cancel else ():
                client.post(f"/jobs/{number}/cancel")
            return READY in one.output() and not left

        if cancel:
            wait_for(one, "the first training", training, STARTED_S)
        wait_for(one, "the end of the rankings", ended, RANKED_S)


def processes(one: Demo) -> Iterator[tuple[str, psutil.Process]]:
    """Yield every process of the demo, with a name for people; PostgreSQL's share one."""
    yield "demo", one.process
    for service in one.process.children():
        name = "web" if "serve" in service.cmdline() else "worker"
        yield name, service
        for child in service.children(recursive=True):
            yield f"{name}: {'forks readers' if name == 'web' else 'forks steps'}", child
    postmaster = psutil.Process(EmbeddedPostgres(one.folder / "postgres", server_user=get_settings().server_user).pid())
    for process in (postmaster, *postmaster.children(recursive=True)):
        yield "PostgreSQL", process


def measure(one: Demo) -> list[Used]:
    """Measure the memory of every process, the largest first."""
    own: list[Used] = []
    server: list[Used] = []
    for name, process in processes(one):
        with contextlib.suppress(psutil.NoSuchProcess):
            memory = process.memory_full_info()
            (server if name == "PostgreSQL" else own).append(Used(name, memory.pss / 1e6, memory.uss / 1e6))
    together = Used(f"PostgreSQL, {len(server)} processes", sum(s.pss_mb for s in server), sum(s.private_mb for s in server))
    return sorted([*own, together], key=lambda used: -used.pss_mb)


def measure_demo(checkout: Path, quick: bool) -> list[Used]:
    """Start a demo, let it work, and measure it when it is idle."""
    with demo(checkout) as one:
        wait_for(one, "the study", one.loaded, STARTED_S)
        finish_jobs(one, quick)
        time.sleep(IDLE_S)
        return measure(one)


def show(title: str, found: list[Used]) -> float:
    """Print the table; return the sum of PSS, MB."""
    total, private = sum(used.pss_mb for used in found), sum(used.private_mb for used in found)
    print(f"{title}\n{'process':<28}{'PSS MB':>9}{'private MB':>12}")
    for used in [*found, Used("together", total, private)]:
        print(f"{used.name:<28}{used.pss_mb:>9.0f}{used.private_mb:>12.0f}")
    return total


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="cancel the rankings once the first training has begun")
    parser.add_argument("--than", type=Path, help="another checkout, measured in the same way before this one")
    options = parser.parse_args()
    figures: dict[str, float | bool] = {}
    if options.than:
        figures["than_mb"] = round(show(str(options.than), measure_demo(options.than.resolve(), options.quick)))
    figures["total_mb"] = total = round(show("this checkout", measure_demo(ROOT, options.quick)))
    if options.than:
        figures["ratio"] = round(total / figures["than_mb"], 3)
    print(json.dumps(figures | {"meets_aim": total <= MOST_MB}))


if __name__ == "__main__":
    run_benchmark(main)
