"""Small files that ask for much: each kind that has ended the service, or made it slow, or could."""

from __future__ import annotations

import io
import json
import struct
import zipfile
from collections.abc import Iterator

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tests.app.ingest.conftest import steady, table
from tests.ml.formats.conftest import Percept, header, info

MEGABYTE = 1 << 20
UNIX = 1_772_445_600


def packets(megabytes: int) -> bytes:
    """Compress a time domain of so many megabytes into a zip of a fiftieth."""
    body = json.dumps({"ChannelSamples": [{"Key": 0, "Value": [0.01] * 50}], "IncludedChannels": 1, "SampleRate": 1, "Units": "millivolts"})
    sink, written = io.BytesIO(), 0
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED, compresslevel=6) as archive, archive.open("D/RawDataTD.json", "w") as out:
        written += out.write(f'[{{"RecordInfo":{json.dumps(info())},"TimeDomainData":['.encode())
        first = 0
        while written < megabytes * MEGABYTE:
            lines = []
            for number in range(first, first + 1000):
                t_s = (number + 1) * 0.1
                head = json.dumps(header(number, t_s, 100))
                gen = 1_700_000_000_000 + round(1000 * t_s)
                lines.append(f'{{"Header":{head},"PacketGenTime":{gen},"PacketRxUnixTime":{gen},{body[1:]}')
            first += 1000
            written += out.write((",".join(lines) + ",").encode())
        out.write(b"{}]}]")
    return sink.getvalue()


def records(stem: str, count: int) -> bytes:
    """Write a log of so many records, each of another time and text."""
    times = [1_700_000_000_000 + 7919 * n % 10**8 for n in range(count)]
    lines = (
        f'{{"RecordInfo":{json.dumps(info(ms))},"Event":{{"EventName":"x","EventType":"{ms % 4999 / 1000} mA","UnixOnsetTime":{ms}}}}}'
        for ms in times
    )
    return _zip({f"D/{stem}.json": f"[{','.join(lines)}]".encode(), "D/StimLog.json": b"[]"})


def percept(samples: int) -> bytes:
    """Write a Percept report with one run of so many samples."""
    report = Percept().one_run()
    report["BrainSenseTimeDomain"][0]["TimeDomainData"] = [1] * samples
    return json.dumps(report).encode()


def _zip(members: dict[str, bytes]) -> bytes:
    sink = io.BytesIO()
    with zipfile.ZipFile(sink, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return sink.getvalue()


def claim() -> bytes:
    """Build an archive whose directory claims 4 GB."""
    raw = bytearray(_zip({"D/RawDataTD.json": b"[]"}))
    at = raw.find(b"PK\x01\x02")
    raw[at + 24 : at + 28] = struct.pack("<I", 4_000_000_000)
    return bytes(raw)


def parquet(rows: int) -> bytes:
    """Write a table of so many equal rows, which take some bytes each thousand."""
    sink = io.BytesIO()
    names = ("t_s", "beta", "amplitude_fraction")
    pq.write_table(pa.table({name: np.ones(rows) for name in names}), sink, compression="zstd", row_group_size=rows)
    return sink.getvalue()


def every_file() -> Iterator[tuple[str, bytes]]:
    """Name and bytes, made one after the other."""
    for unit, factor in (("seconds", 1), ("milliseconds", 1000), ("nanoseconds", 10**9)):
        yield f"unix {unit}.csv", table([(factor * (UNIX + 2 * k), 1.0, 1.0) for k in range(60)])
    yield "one step at 1.7e9 s.csv", table([(2.0, 1.0, 1.0), (1.7e9, 1.0, 1.0)])
    yield "600 MB of packets.zip", packets(600)
    yield "80 MB of zeros.zip", _zip({"D/RawDataTD.json": bytes(80 * MEGABYTE)})
    yield "a claim of 4 GB.zip", claim()
    yield "60 000 members.zip", _zip({f"{n}.json": b"" for n in range(60_000)})
    yield "2 000 members.zip", _zip({f"folder {n}/x{n}.zip": b"" for n in range(2_000)})
    yield "150 000 events.zip", records("EventLog", 150_000)
    yield "150 000 errors.zip", records("ErrorLog", 150_000)
    yield "40 000 000 samples.json", percept(40_000_000)
    yield "nested.json", b'{"SessionDate": ' + b"[" * (20 * MEGABYTE)
    yield "ten million keys.json", b'{"SessionDate": "x", "BrainSenseLfp": {' + b",".join(b'"%d":{}' % n for n in range(5_000_000)) + b"}}"
    yield "one line.csv", b"t_s,beta,amplitude_fraction," + b"x" * (100 * MEGABYTE)
    yield "two million rows.csv", b"t_s,beta,amplitude_fraction\n" + b"".join(b"%d,1,1\n" % (2 * n) for n in range(2_000_000))
    yield "a million columns.csv", b"t_s,beta,amplitude_fraction" + b",c" * 1_000_000 + b"\n"
    yield "half a million minutes.csv", b"time,class\n" + b"".join(b"%d,none\n" % (UNIX + 60 * n) for n in range(490_000))
    yield "half a million grasps.csv", b"t_s\n" + b"".join(b"%d\n" % n for n in range(490_000))
    yield "100 million rows.parquet", parquet(100_000_000)
    yield "the last.csv", steady(1)
