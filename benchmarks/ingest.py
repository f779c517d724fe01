"""Speed and memory of `app.ingest`: CPU seconds, one thread, peers timed in turn within the same run.

    python benchmarks/ingest.py [--megabytes N] [--repeats N] [--quick]

`decode_vs_orjson`: RawDataTD.json from disk to float arrays, against `orjson.loads` of the same file with one array per channel (orjson is
in the `bench` extra). `peak_rss_mb`: highest memory of a fresh process that decodes a session with a time-domain file of so many megabytes
whole, traces and spectra included. `lfp_redact_s`, `lfp_decode_s`: CPU of cleaning a table of raw LFP, and of decoding it.
`upload_quiet_s`, `upload_training_s`: wall seconds from sending a device recording until its decoded session can be read over the API. It
is the montage of the test recordings, else a synthetic one. Each is the median over fresh participants, on a service of its own, without
and with a training job on its worker. `upload_cpu_s`: CPU seconds of the web process and of the children that read its files, per upload.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import os
import random
import socket
import statistics
import subprocess
import sys
import tempfile
import time
import zipfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import httpx2 as httpx
import numpy as np
import psutil
from support.results import run_benchmark

from ml.formats import DecodeOptions, decode
from ml.formats.rcs.folder import decode_rcs
from ml.formats.rcs.packets.json_elements import JsonNotes, read_elements
from ml.formats.rcs.packets.scan import scan
from ml.formats.rcs.packets.streams import read_time_domain
from ml.formats.rcs.redact import redact_rcs_zip
from ml.formats.tables.redact import redact_table
from ml.population import rcs_session_zip, run_session, session_table_csv

START_MS, DEVICE_START_S = 1_700_000_000_000, 700_000_000
RATE_HZ, PER_PACKET, CHANNELS = 500, 50, (0, 2)
TEMPLATES = 200
WHOLE_MB = 100
KEY = b"a key for benchmarks"


def time_domain_file(path: Path, megabytes: float) -> None:
    """Write a RawDataTD.json of so many megabytes: two channels at 500 Hz, clocks running on, every 50th packet lost."""
    numbers = random.Random(0)
    bodies = [
        json.dumps(
            {
                "ChannelSamples": [
                    {"Key": key, "Value": [round(numbers.gauss(0, 0.02), 6) for _ in range(PER_PACKET)]} for key in CHANNELS
                ],
                "DebugInfo": 0,
                "EvokedMarker": [],
                "IncludedChannels": 5,
                "SampleRate": 1,
                "Units": "millivolts",
            },
            separators=(",", ":"),
        )[1:]
        for _ in range(TEMPLATES)
    ]
    with path.open("w") as out:
        out.write(f'[{{"RecordInfo":{{"DeviceId":"SYN000001H","HostUnixTime":{START_MS},"SessionId":"{START_MS}"}},"TimeDomainData":[')
        for i, packet in enumerate(_packets(bodies)):
            if out.tell() >= megabytes * 1e6:
                break
            out.write(("," if i else "") + packet)
        out.write("]}]")


def _packets(bodies: list[str]) -> Iterator[str]:
    for i in range(10**9):
        if i % 50 == 49:
            continue
        ms = (i + 1) * 1000 * PER_PACKET // RATE_HZ
        header = {
            "dataSize": 2 * PER_PACKET * len(CHANNELS),
            "dataType": 1,
            "dataTypeSequence": i % 256,
            "globalSequence": i % 256,
            "info": 0,
            "systemTick": 10 * ms % 65_536,
            "timestamp": {"seconds": DEVICE_START_S + ms // 1000},
            "user1": 1,
            "user2": 5,
        }
        times = f'"PacketGenTime":{START_MS + ms},"PacketRxUnixTime":{START_MS + ms + 40}'
        yield f'{{"Header":{json.dumps(header, separators=(",", ":"))},{times},{bodies[i % TEMPLATES]}'


def ours(path: Path) -> list[Any]:
    """Read the samples per channel by the product's reader."""
    with path.open("rb") as stream:
        data = read_time_domain(batch for batch, _ in read_elements(stream, JsonNotes(), scan))
    return [x for x in data.samples if x.size]


def peer(path: Path) -> list[Any]:
    """Read the samples per channel by orjson, which makes a Python object of every number, and numpy."""
    import orjson

    channels: dict[int, list[Any]] = {}
    for packet in orjson.loads(path.read_bytes())[0]["TimeDomainData"]:
        for channel in packet["ChannelSamples"]:
            channels.setdefault(channel["Key"], []).append(np.array(channel["Value"], dtype=np.float64))
    return [np.concatenate(pieces) for _, pieces in sorted(channels.items())]


def cpu_s(work: Callable[[], Any]) -> float:
    """Measure the CPU seconds of one call."""
    start = time.process_time()
    work()
    return time.process_time() - start


def whole_decode_peak_mb(folder: Path) -> float:
    """Measure the highest resident memory in MB of a process that decodes the folder and does nothing else."""
    code = (
        "import sys; from pathlib import Path\n"
        "from ml.formats import DecodeOptions, decode\n"
        "(recording,) = decode(Path(sys.argv[1]), 'rcs', DecodeOptions()).recordings\n"
        "assert recording.traces\n"
        # not ru_maxrss: that begins with the memory of the process which started this one
        "peak = next(line for line in open('/proc/self/status') if line.startswith('VmHWM'));"
        "print(int(peak.split()[1]) / 1000)"
    )
    done = subprocess.run([sys.executable, "-c", code, str(folder)], check=True, capture_output=True, text=True)
    return float(done.stdout)


def decode_figures(options: argparse.Namespace, folder: Path) -> tuple[dict[str, float], dict[str, float]]:
    """Measure decoding; print each figure as it comes."""
    path = folder / "RawDataTD.json"
    time_domain_file(path, options.megabytes)
    size_mb = path.stat().st_size / 1e6
    figures: dict[str, float] = {"megabytes": size_mb}
    ratios: dict[str, float] = {}
    works: dict[str, Callable[[], Any]] = {"betaloop": lambda: ours(path)}
    if importlib.util.find_spec("orjson") is not None:
        works["orjson"] = lambda: peer(path)
        if not all(np.array_equal(a, b) for a, b in zip(ours(path), peer(path), strict=True)):
            raise SystemExit("betaloop and orjson read different numbers")
    else:
        print("orjson is not installed (the `bench` extra): no decode_vs_orjson")
    ours(path)
    times = {name: [0.0] * options.repeats for name in works}
    for i in range(options.repeats):
        for name, work in works.items():
            times[name][i] = cpu_s(work)
    print(f"{'RawDataTD.json to arrays':<28}{'CPU s':>8}{'MB/s':>8}")
    for name, values in times.items():
        figures[f"{name}_s"] = statistics.median(values)
        print(f"{name:<28}{figures[f'{name}_s']:>8.3f}{size_mb / figures[f'{name}_s']:>8.0f}")
    if "orjson" in times:
        ratios["decode_vs_orjson"] = figures["orjson_s"] / figures["betaloop_s"]
        print(f"decode_vs_orjson {ratios['decode_vs_orjson']:.2f}")

    zipped, clean = folder / "session.zip", folder / "clean.zip"
    with zipfile.ZipFile(zipped, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.write(path, "DeviceSYN000001H/RawDataTD.json")
    for name, work in (
        ("redact zip", lambda: redact_rcs_zip(zipped, clean, KEY)),
        ("decode redacted zip", lambda: decode_rcs(clean, DecodeOptions())),
    ):
        figures[name.replace(" ", "_") + "_s"] = seconds = cpu_s(work)
        print(f"{name:<28}{seconds:>8.3f}{size_mb / seconds:>8.0f}")
    return figures, ratios


def table_figures(options: argparse.Namespace, folder: Path) -> dict[str, float]:
    """Measure the CPU of taking in a table of raw LFP: cleaning it, and decoding what is stored."""
    path, clean = folder / "lfp.csv", folder / "clean.csv"
    rows = options.lfp_rows
    values = np.random.default_rng(0).normal(0, 20, rows).round(4).tolist()
    with path.open("w") as out:
        out.write("t_s,lfp [uV],amplitude_ma\n")
        out.writelines(f"{(i + 1) / 250:.3f},{x!r},{2.5 if i % 2000 < 1000 else 3.0}\n" for i, x in enumerate(values))
    figures = {
        "lfp_redact_s": cpu_s(lambda: redact_table(path, clean, "csv", DecodeOptions())),
        "lfp_decode_s": cpu_s(lambda: decode(clean)),
    }
    print(f"raw LFP of {rows} rows: cleaned in {figures['lfp_redact_s']:.2f} s, decoded in {figures['lfp_decode_s']:.2f} s of CPU")
    return figures


def memory_figures(options: argparse.Namespace, folder: Path) -> dict[str, float]:
    """Measure the peak memory of a whole decode."""
    time_domain_file(folder / "RawDataTD.json", options.whole_megabytes)
    peak = whole_decode_peak_mb(folder)
    print(f"peak memory of decoding a time domain of {options.whole_megabytes:g} MB: {peak:.0f} MB")
    return {"peak_rss_mb": peak}


def device_recording() -> tuple[str, bytes]:
    """Name and bytes of the recording that is uploaded: real where the test recordings are, else synthetic."""
    folder = Path(os.environ.get("BETALOOP_TEST_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
    real = folder / "rcs" / "montage_packet_loss.zip"
    if real.exists():
        return real.name, real.read_bytes()
    made = run_session("P1", "random", visit=1, hour=1.0, seed=0, steps=100, lead_steps=10, resolution_ma=0.1)
    return "synthetic.zip", rcs_session_zip(made, started_ms=START_MS)


@contextmanager
def service(folder: Path) -> Iterator[tuple[httpx.Client, int]]:
    """Run a web service and a worker with a database of their own; yield a client, and the web process."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    environment = os.environ | {"BETALOOP_DATA_DIR": str(folder), "OMP_NUM_THREADS": "1"}
    environment.pop("BETALOOP_DATABASE_URL", None)

    def command(*arguments: str, **named: Any) -> subprocess.CompletedProcess[str]:
        return subprocess.run(
            [sys.executable, "-m", "app.cli", *arguments], env=environment, check=True, capture_output=True, text=True, **named
        )

    command("migrate")
    command("user", "add", "bench@clinic.example", "--role", "admin", "--password-file", "-", input="a password for benchmarks\n")
    token = command("token", "create", "bench@clinic.example", "--name", "bench").stdout.strip()
    log = (folder / "service.log").open("wb")
    children = [
        subprocess.Popen([sys.executable, "-m", "app.cli", *arguments], env=environment, stdout=log, stderr=log)
        for arguments in (["serve", "--port", str(port)], ["worker", "--slots", "2"])
    ]
    headers = {"Authorization": f"Bearer {token}"}
    try:
        with httpx.Client(base_url=f"http://127.0.0.1:{port}/api/v1", headers=headers, timeout=120) as client:
            _wait_until(lambda: _answers(client), 90)
            yield client, children[0].pid
    finally:
        for child in reversed(children):
            child.terminate()
        for child in children:
            child.wait(timeout=30)
        log.close()


def _process_cpu_s(pid: int) -> float:
    """Sum the CPU seconds that a process has used, with the process that forks its readers and the readers that have ended."""
    at = psutil.Process(pid)
    times = [p.cpu_times() for p in (at, *at.children(recursive=True))]
    return sum(t.user + t.system for t in times) + sum(t.children_user + t.children_system for t in times[1:])


def _answers(client: httpx.Client) -> bool:
    try:
        return client.get("/participants").status_code == 200
    except httpx.TransportError:
        return False


def _wait_until(ready: Callable[[], bool], seconds: float) -> None:
    deadline = time.monotonic() + seconds
    while not ready():
        if time.monotonic() > deadline:
            raise SystemExit("the service did not get ready in time")
        time.sleep(0.2)


def _enrol(client: httpx.Client, code: str) -> None:
    settings = {"xi_beta": 1.0, "cdbs_amplitude_ma": 3.0, "beta_unit": "uV", "beta_source": "table"}
    client.post("/participants", json={"code": code, "settings": settings}).raise_for_status()
    client.post(f"/participants/{code}/visits", json={"number": 1}).raise_for_status()


def upload_s(client: httpx.Client, code: str, name: str, content: bytes) -> float:
    """Measure the wall seconds from the begin of an upload for a fresh participant until its session's trace can be read."""
    _enrol(client, code)
    fields = {"participant": code, "visit": "1", "controller": "other"}
    start = time.perf_counter()
    answer = client.post("/uploads", data=fields, files={"file": (name, content)})
    answer.raise_for_status()
    trace = client.get(f"/sessions/{answer.json()['sessions'][0]['id']}/trace")
    trace.raise_for_status()
    if not any(b is not None for b in trace.json()["beta"]):
        raise SystemExit("the uploaded session has no beta")
    return time.perf_counter() - start


def _start_training(client: httpx.Client) -> str:
    """Start a training job that outlasts the uploads; return its id once it computes."""
    _enrol(client, "T0")
    for i in range(6):
        content = session_table_csv(run_session("P2", "random", visit=1, hour=1.0, seed=i, steps=300, lead_steps=10))
        fields = {"participant": "T0", "visit": "1", "controller": "random"}
        stored = client.post("/uploads", data=fields, files={"file": (f"{i}.csv", content)})
        stored.raise_for_status()
        qoc = {"grasp_hz": 2.0 + 0.1 * i, "rating": 5 + i % 4, "tremor_percent": 10.0 + i}
        client.put(f"/sessions/{stored.json()['sessions'][0]['id']}/qoc", json=qoc).raise_for_status()
    job = client.post("/participants/T0/jobs", json={"kind": "train"})
    if job.status_code >= 400:
        raise SystemExit(f"the training job was refused: {job.text}")
    number = str(job.json()["id"])
    _wait_until(lambda: any(s["status"] == "running" for s in client.get(f"/jobs/{number}").json()["steps"]), 90)
    time.sleep(5)  # the compute children are past their imports
    return number


def latency_figures(options: argparse.Namespace, folder: Path) -> tuple[dict[str, float], dict[str, float]]:
    """Measure figures and ratios of uploads; print them."""
    name, content = device_recording()
    with service(folder) as (client, web):
        upload_s(client, "W0", name, content)
        before = _process_cpu_s(web)
        quiet = [upload_s(client, f"Q{i}", name, content) for i in range(options.uploads)]
        cpu = (_process_cpu_s(web) - before) / options.uploads
        job = _start_training(client)
        busy = [upload_s(client, f"B{i}", name, content) for i in range(options.uploads)]
        running = client.get(f"/jobs/{job}").json()["status"]
        client.post(f"/jobs/{job}/cancel").raise_for_status()
    if running != "running":
        raise SystemExit(f"the training job had {running} before the uploads ended: use fewer uploads")
    figures = {"upload_quiet_s": statistics.median(quiet), "upload_training_s": statistics.median(busy), "upload_cpu_s": cpu}
    ratio = figures["upload_training_s"] / figures["upload_quiet_s"]
    load = os.getloadavg()[0]
    print(f"{name}: {len(content) / 1e6:.1f} MB, {os.cpu_count()} cores, load average {load:.1f}, n = {options.uploads} each")
    print(f"{'upload to decoded session':<28}{'median s':>9}{'worst s':>9}")
    print(f"{'quiet':<28}{figures['upload_quiet_s']:>9.2f}{max(quiet):>9.2f}")
    print(f"{'while training':<28}{figures['upload_training_s']:>9.2f}{max(busy):>9.2f}")
    print(f"upload_training_vs_quiet {ratio:.2f}, CPU of web process and readers per upload {cpu:.2f} s")
    return figures, {"upload_training_vs_quiet": ratio}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--megabytes", type=float, default=50.0, help="size of the file that is timed")
    parser.add_argument("--whole-megabytes", type=float, default=WHOLE_MB, help="size of the file whose decoding is weighed")
    parser.add_argument("--lfp-rows", type=int, default=1_000_000, help="rows of the table of raw LFP")
    parser.add_argument("--repeats", type=int, default=7, help="timings per peer")
    parser.add_argument("--uploads", type=int, default=7, help="uploads timed on a quiet and on a training service")
    parser.add_argument("--only", choices=("decode", "upload"), help="one half alone")
    parser.add_argument("--quick", action="store_true", help="a small file and few repeats, for a first look")
    options = parser.parse_args()
    if options.quick:
        options.megabytes, options.repeats, options.uploads, options.lfp_rows = 10.0, 3, 3, 100_000
    figures: dict[str, float] = {}
    ratios: dict[str, float] = {}
    with tempfile.TemporaryDirectory() as timed, tempfile.TemporaryDirectory() as weighed, tempfile.TemporaryDirectory() as data:
        if options.only != "upload":
            figures, ratios = decode_figures(options, Path(timed))
            figures |= table_figures(options, Path(weighed)) | memory_figures(options, Path(weighed))
        if options.only != "decode":
            more, shares = latency_figures(options, Path(data))
            figures, ratios = figures | more, ratios | shares
    print(json.dumps({"name": "ingest", "figures": figures, "ratios": ratios, "baseline": "orjson.loads and numpy"}))


if __name__ == "__main__":
    run_benchmark(main)
