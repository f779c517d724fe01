"""Real recordings with edited bytes: each is decoded or refused in words, keeps no identity, and costs no more than it is worth."""

from __future__ import annotations

import io
import json
import random
import re
import time
import zipfile
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from ml.formats import UndecodableFile, decode, redact, sniff

SOURCES = (
    "rcs/stim_sweep.zip",
    "rcs/embedded_adaptive.zip",
    "rcs/montage_packet_loss.zip",
    "rcs/empty_streams.zip",
    "percept/percept_session_report.zip",
    "percept/group_history.json",
    "tremor/strivepd_long.csv",
    "tremor/strivepd_wide.csv",
)
KEY = b"a key of the clinic's own"
TEXT_OF_A_STREAM = 12_000
"""Characters of each file of an RC+S session that are kept: enough for some packets, little enough for thousands of readings."""
ROWS = 6
"""Of each list of a report that are kept."""
MOST_S = 10.0
"""Of the processor for one file of this size."""
PIECES = [*(bytes([c]) for c in b'"{}[],:-\\\x00\xff\n'), b"1e999", b"NaN", b"null", b"true", b"9" * 400, b"-0"]
IDENTITY = re.compile(rb"NPC\d{6}H", re.IGNORECASE)

Members = dict[str, bytes]


def trimmed(value: Any) -> Any:
    """Trim a report to the first rows of each of its lists."""
    if isinstance(value, list):
        return [trimmed(v) for v in value[:ROWS]]
    return {k: trimmed(v) for k, v in value.items()} if isinstance(value, dict) else value


def small(path: Path) -> Members:
    """Return the files in a recording by their names, shortened."""
    if path.suffix == ".zip":
        with zipfile.ZipFile(path) as archive:
            members = {name: archive.read(name) for name in archive.namelist() if not name.endswith("/")}
    else:
        members = {path.name: path.read_bytes()}
    if path.parent.name == "percept":
        return {n: json.dumps(trimmed(json.loads(b.decode("utf-8-sig")))).encode() if n.endswith("json") else b for n, b in members.items()}
    return {name: content[:TEXT_OF_A_STREAM] for name, content in members.items()}


def packed(members: Members, path: Path) -> bytes:
    """Pack the recording as it is uploaded."""
    if path.suffix != ".zip":
        return next(iter(members.values()))
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_STORED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return sink.getvalue()


def edited(content: bytes, rng: random.Random) -> bytes:
    """Make one edit of some bytes, of the kinds that transfers, disks and people make."""
    if not content:
        return rng.choice(PIECES)
    at = rng.randrange(len(content))
    upto = min(len(content), at + rng.choice([1, 2, 8, 64, 1024]))
    edits: list[Callable[[], bytes]] = [
        lambda: content[:at] + bytes([content[at] ^ 1 << rng.randrange(8)]) + content[at + 1 :],
        lambda: content[:at] + rng.choice(PIECES) + content[at + 1 :],
        lambda: content[:at] + rng.choice(PIECES) + content[at:],
        lambda: content[:at] + content[upto:],
        lambda: content[:upto] + content[at:],
        lambda: content[:at],
        lambda: content[:at] + bytes(upto - at) + content[upto:],
        lambda: re.sub(rb"\d+", lambda m: rng.choice([b"0", b"-1", b"65535", b"4294967296", m[0] * 3]), content[at:upto], count=1).join(
            [content[:at], content[upto:]]
        ),
    ]
    return rng.choice(edits)()


def variants(path: Path, number: int, rng: random.Random) -> Iterator[bytes]:
    """Yield the recording with one to four edits of a file in it, now and then of the archive itself."""
    members = small(path)
    for _ in range(number):
        now = dict(members)
        whole = rng.random() < 0.15
        name = rng.choice(sorted(now))
        for _ in range(rng.randint(1, 4)):
            now[name] = now[name] if whole else edited(now[name], rng)
        content = packed(now, path)
        yield edited(content, rng) if whole else content


def read(source: Path, clean: Path) -> str:
    """Clean and decode a file as the service does; what became of it. Raises what no file may raise."""
    begun = time.process_time()
    try:
        kind = sniff(source)
        redact(source, clean, kind, KEY)
        found = decode(clean, kind)
    except UndecodableFile as error:
        found, refusal = None, error
    assert time.process_time() - begun < MOST_S
    if found is None:
        assert refusal.what
        assert refusal.hint, f"{refusal.what}: without what to do about it"
        return "refused"
    for recording in found.recordings:
        for trace in recording.traces:
            values, times = trace.values[trace.valid], trace.t_end_s
            assert np.isfinite(values).all()
            assert np.isfinite(times).all()
            assert (np.diff(times) > 0).all()
    return "decoded"


def readings(recordings: Path, folder: Path, each: int, seed: int) -> Counter[str]:
    """Count the results of reading edits of every recording; the first bytes that break a promise are kept in `folder`."""
    told: Counter[str] = Counter()
    for place in SOURCES:
        path = recordings / place
        for number, content in enumerate(variants(path, each, random.Random(f"{seed} {place}"))):
            source, clean = folder / f"edited{path.suffix}", folder / "clean"
            source.write_bytes(content)
            clean.unlink(missing_ok=True)
            try:
                told[read(source, clean)] += 1
            except Exception as fault:
                raise AssertionError(f"edit {number} of {place} (seed {seed}): {type(fault).__name__}: {fault}") from fault
            if clean.exists() and path.parent.name == "rcs":
                with zipfile.ZipFile(clean) as archive:
                    left = [name for name in archive.namelist() if IDENTITY.search(archive.read(name)) or IDENTITY.search(name.encode())]
                assert left == [], f"edit {number} of {place} (seed {seed}) keeps the name of a device"
    return told


def test_edited_bytes_of_real_recordings_are_decoded_or_refused_in_words(recordings: Path, tmp_path: Path) -> None:
    told = readings(recordings, tmp_path, 15, 0)
    assert set(told) == {"decoded", "refused"}


@pytest.mark.slow
@pytest.mark.timeout(1200)
@pytest.mark.parametrize("seed", [1, 2])
def test_five_thousand_edits_of_real_recordings_are_decoded_or_refused_in_words(recordings: Path, tmp_path: Path, seed: int) -> None:
    told = readings(recordings, tmp_path, 2500 // len(SOURCES) + 1, seed)
    print(dict(sorted(told.items())))  # noqa: T201 - for docs/reliability.md, shown by `pytest -s`
    assert told.total() >= 2500
    assert min(told["decoded"], told["refused"]) > 100
