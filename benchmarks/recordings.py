"""Samples and amplitudes that are wrong in random files of every lab format, and what reading a large file takes.

    python benchmarks/recordings.py [--files 500] [--kinds nwb bids] [--quick]

The files are those of `tests/ml/formats/peers`, written by another library or by the specification, with known samples, bursts, gaps and
steps. Nothing may be wrong, at least 95 % of what a perfect reader could use must be usable. A large file is then read by the format's
reader and by the library alone, each in a process of its own. CPU is in seconds; memory is the peak above that of the imports.
"""

from __future__ import annotations

import argparse
import json
import subprocess
import sys
import tempfile
from collections import Counter
from pathlib import Path

import numpy as np

if __name__ == "__main__":
    sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from ml.formats import DecodeOptions, UndecodableFile, decode, redact, sniff
from tests.ml.formats.peers.check import compare
from tests.ml.formats.peers.files import LARGE, WRITERS

ROOT = Path(__file__).resolve().parents[1]
MEASURE = """
import json, sys, time
from pathlib import Path
path = Path(sys.argv[1])
{imports}
# of this program alone: getrusage counts the process that it was forked from too
peak = lambda: 1024 * int(Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0])
before, begin = peak(), time.process_time()
{work}
print(json.dumps([time.process_time() - begin, peak() - before]))
"""
OURS = """
def work():
    found = {reader}(path, FileReport("file"))
    return sum(float(c.read().sum()) for c in found.channels)
work()
"""
READERS = {
    "bids": (
        "from ml.formats.archive import ZipFiles\nfrom ml.formats.bids.read import find_runs, read_run\nfrom ml.formats.options import "
        "ArchiveLimits\ndef reader(path, report):\n    with ZipFiles(path, ArchiveLimits()) as files:\n"
        "        return read_run(files, find_runs(files)[0][0], report)",
        "import edfio, io, zipfile",
        "z = zipfile.ZipFile(path)\nraw = z.read(next(n for n in z.namelist() if '.edf' in n))\n"
        "x = [s.data for s in edfio.read_edf(io.BytesIO(raw)).signals]",
    ),
    "edf": ("from ml.formats.edf.read import read_edf as reader", "import edfio", "x = [s.data for s in edfio.read_edf(path).signals]"),
    "nwb": (
        "from ml.formats.nwb.read import read_nwb as reader\nimport h5py",
        "import pynwb",
        "x = [s.get_data_in_units() for s in pynwb.NWBHDF5IO(str(path), 'r').read().acquisition.values()]",
    ),
    "xdf": ("from ml.formats.xdf.read import read_xdf as reader\nimport pyxdf", "import pyxdf", "x = pyxdf.load_xdf(str(path))"),
}
"""By kind: import of our reader, import of the library, and how the library loads all samples."""


def judge(kind: str, files: int, folder: Path) -> tuple[Counter[str], list[str]]:
    """Decode random files of one kind; returns counts, and a sentence per fault."""
    total: Counter[str] = Counter()
    faults = []
    for seed in range(files):
        written = WRITERS[kind](folder / "file", np.random.default_rng([seed, 1000]))
        try:
            redact(folder / "file", folder / "clean", sniff(folder / "file"), bytes(32))
            found = decode(folder / "clean", kind, DecodeOptions(keep_samples=True))
        except UndecodableFile as error:
            total["unreadable"] += 1
            faults.append(f"{kind} {seed}: {error}")
            continue
        outcome = compare(found.recordings, written.truth, written.names, written.lsb_uv, pause=written.pause, steps=written.steps)
        for name in outcome.__dataclass_fields__:
            total[name] += getattr(outcome, name)
        if outcome.wrong_samples or outcome.wrong_steps:
            faults.append(f"{kind} {seed}: {outcome}")
    return total, faults


def measure(path: Path, imports: str, work: str) -> tuple[float, float]:
    """Run a reader in a process of its own; returns CPU seconds and bytes of memory."""
    code = MEASURE.format(imports=imports, work=work)
    out = subprocess.run([sys.executable, "-c", code, str(path)], cwd=ROOT, check=True, capture_output=True, text=True).stdout
    cpu, memory = json.loads(out.splitlines()[-1])
    return cpu, memory


def main() -> None:
    """Print the figures."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--files", type=int, default=500, help="random files of each format")
    parser.add_argument("--kinds", nargs="+", choices=sorted(WRITERS), default=sorted(WRITERS), help="formats to measure (default: all)")
    parser.add_argument("--quick", action="store_true", help="five files of each format, and a large one of 5 MB")
    args = parser.parse_args()
    files, megabytes = (5, 5) if args.quick else (args.files, 50)
    sys.stdout.write(
        "| format | files | samples | wrong | usable | known steps | wrong | usable | unreadable |\n|---|---|---|---|---|---|---|---|---|\n"
    )
    faults: list[str] = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        for kind in sorted(args.kinds):
            n, found = judge(kind, files, folder)
            faults += found
            usable, known = 100 * n["found_samples"] / max(1, n["samples"]), 100 * n["known_steps"] / max(1, n["steps"])
            sys.stdout.write(
                f"| {kind} | {files} | {n['samples']} | {n['wrong_samples']} | {usable:.2f} % | {n['steps']} | {n['wrong_steps']} | "
                f"{known:.2f} % | {n['unreadable']} |\n"
            )
        sys.stdout.write(
            "\n| format | file | CPU, library | CPU, ours | ratio | memory, library | memory, ours |\n|---|---|---|---|---|---|---|\n"
        )
        for kind, (ours, library, load) in ((k, v) for k, v in READERS.items() if k in args.kinds):
            LARGE[kind](folder / "large", megabytes)
            redact(folder / "large", folder / "clean", kind, bytes(32))
            size = (folder / "clean").stat().st_size
            theirs, own = [], []
            for _ in range(3):
                theirs.append(measure(folder / "large", library, load))
                own.append(measure(folder / "clean", f"from ml.formats.recording import FileReport\n{ours}", OURS.format(reader="reader")))
            cpu, cpu_own = (min(r[0] for r in runs) for runs in (theirs, own))
            memory, memory_own = (max(r[1] for r in runs) / size for runs in (theirs, own))
            sys.stdout.write(
                f"| {kind} | {size / 1e6:.0f} MB | {cpu:.2f} s | {cpu_own:.2f} s | {cpu_own / cpu:.2f} | "
                f"{memory:.1f} x file | {memory_own:.1f} x file |\n"
            )
    sys.stdout.write("".join(f"{fault}\n" for fault in faults[:40]))


if __name__ == "__main__":
    from support.results import run_benchmark

    run_benchmark(main)
