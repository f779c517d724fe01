"""Bytes on their way in: a killed process leaves none behind, no other user can read them, and a full disk does not stay full."""

from __future__ import annotations

import hashlib
import io
import os
import random
import signal
import stat
import subprocess
import sys
from pathlib import Path

import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from app.platform import files, raw_bytes
from app.platform.web import forms
from app.settings import get_settings

ROOT = Path(__file__).resolve().parents[4]
NAME = b"NAME-OF-THE-PATIENT"
UPLOAD = """
import io, sys, time
from app.accounts.permissions import SYSTEM
from app.ingest.uploads import service
from app.ingest.uploads import reading
from app.ingest.sessions import StatedSession
from app.platform.database import new_session
from app.study.repository import participant_by_code

def stay(*_, **__):
    print("here", flush=True)
    time.sleep(600)

class Slow(io.BytesIO):
    def read(self, n=-1):
        if sys.argv[1] == "coming" and self.tell() > 3 << 20:
            stay()
        return super().read(n)

if sys.argv[1] == "cleaning":
    reading.clean = stay
raw = b"t_s,beta,amplitude_fraction,note\\n" + b"".join(b"%d,1,1,NAME-OF-THE-PATIENT\\n" % (2 * k) for k in range(1, 250_000))
with new_session() as db:
    service.receive(db, participant_by_code(db, "P1", SYSTEM), StatedSession(), [service.Incoming("t.csv", Slow(raw))], SYSTEM)
"""


def stored() -> list[Path]:
    return [p for p in get_settings().files_dir.rglob("*") if p.is_file()]


def incoming() -> Path:
    return get_settings().files_dir / "incoming"


def assert_open_files_show_nothing(process: subprocess.Popen[bytes]) -> None:
    """Require that the disk shows megabytes of an upload while it comes, and no name."""
    content = {os.readlink(p): p.read_bytes() for p in Path(f"/proc/{process.pid}/fd").iterdir() if p.is_file()}
    assert sum(map(len, content.values())) > 2 << 20
    assert [name for name, held in content.items() if NAME in held] == []


@pytest.mark.parametrize("moment", ["coming", "cleaning"])
def test_a_process_killed_in_mid_upload_leaves_no_raw_bytes(participant_code: str, moment: str) -> None:
    with subprocess.Popen([sys.executable, "-c", UPLOAD, moment], cwd=ROOT, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"here\n", "the upload is in its middle"
        (folder,) = incoming().iterdir()
        assert stat.S_IMODE(folder.stat().st_mode) == 0o700
        assert {stat.S_IMODE(p.stat().st_mode) for p in folder.iterdir()} == {0o600}
        assert files.remove_abandoned() == 0
        assert folder.is_dir(), "a live process keeps what it writes"
        assert_open_files_show_nothing(process)
        os.kill(process.pid, signal.SIGKILL)
    assert [p for p in stored() if NAME in p.read_bytes()] == []
    assert sum(p.stat().st_size for p in stored()) == 0, "nothing of it keeps the disk full"
    files.remove_abandoned()
    assert list(incoming().iterdir()) == []


def test_the_start_of_the_service_removes_what_killed_processes_left(service_app: FastAPI) -> None:
    own = files.draft_path()
    own.write_bytes(b"being written")
    dead = incoming() / "0123456789abcdef"
    dead.mkdir()
    (dead / ".lock").touch()
    (dead / "draft").write_bytes(NAME)
    (incoming() / "draft-of-an-earlier-version").write_bytes(NAME)
    with TestClient(service_app) as client:
        assert client.get("/healthz").status_code == 200
    assert [p for p in incoming().rglob("*") if p.is_file() and p.name != ".lock"] == [own]
    assert not dead.exists()


FULL = """
import io, resource, sys
from app.ingest import encryption
from app.platform import files, raw_bytes
resource.setrlimit(resource.RLIMIT_FSIZE, (1 << 20, 1 << 20))
source = sys.argv[1]
big = bytes(5 << 20)
for action in (
    lambda: files.keep_bytes(big),
    lambda: encryption.encrypt(__import__("pathlib").Path(source)),
    lambda: raw_bytes.received(io.BytesIO(big), 1 << 30).__enter__(),
):
    try:
        action()
    except OSError as error:
        print(error.errno)
"""


def test_what_does_not_fit_on_the_disk_leaves_nothing_there(fresh_database: str, tmp_path: Path) -> None:
    source = tmp_path / "source"
    source.write_bytes(bytes(5 << 20))
    done = subprocess.run([sys.executable, "-c", FULL, str(source)], cwd=ROOT, capture_output=True, text=True, check=True)
    assert len(done.stdout.split()) == 3, done.stderr
    assert [p for p in stored() if p.name != ".lock"] == []


def test_without_a_list_of_open_files_the_bytes_have_a_name_that_only_the_owner_reads(
    fresh_database: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(files, "_OPEN_FILES", Path("/nowhere"))
    with raw_bytes.received(io.BytesIO(NAME), 100) as (raw, _, size):
        assert (raw.open().read(), size) == (NAME, len(NAME))
        assert NAME not in raw.encrypted.read_bytes()
        assert {stat.S_IMODE(p.stat().st_mode) for p in (raw.encrypted, raw.key)} == {0o600}
    assert not raw.encrypted.exists()
    assert not raw.key.exists()


def test_raw_bytes_have_no_name_are_encrypted_and_can_be_opened_by_their_owner(fresh_database: str) -> None:
    with raw_bytes.received(io.BytesIO(NAME), 100) as (raw, sha256, _):
        assert raw.open().read() == NAME
        assert raw.sha256() == sha256 == hashlib.sha256(NAME).hexdigest()
        assert NAME not in raw.encrypted.read_bytes()
        assert [p for p in incoming().rglob("*") if p.is_file() and p.name != ".lock"] == []
        assert "memfd" in os.readlink(raw.key), "the key is on no disk"
        later = raw.open()
    assert later.read() == NAME, "what is open stays open"
    with pytest.raises(OverflowError), raw_bytes.received(io.BytesIO(NAME), 3):
        pass


def test_any_place_of_raw_bytes_is_read_and_written_as_in_a_plain_file(fresh_database: str) -> None:
    rng, plain = random.Random(7), io.BytesIO()
    with raw_bytes.raw_file() as (out, raw):
        for _ in range(200):
            begin, part = rng.randrange(plain.getbuffer().nbytes + 1), rng.randbytes(rng.randrange(1, 70))
            for sink in (out, plain):
                sink.seek(begin)
                sink.write(part)
        size = plain.getbuffer().nbytes
        assert raw.open().read() == plain.getvalue()
        with raw.open() as stream:
            for _ in range(200):
                begin, length = rng.randrange(size), rng.randrange(1, 100)
                stream.seek(begin)
                assert stream.read(length) == plain.getvalue()[begin : begin + length]
            stream.seek(-5, os.SEEK_END)
            assert stream.read() == plain.getvalue()[-5:]


FORM = """
import asyncio, sys
from app.platform.web.forms import EncryptedForm

head = b'--b\\r\\nContent-Disposition: form-data; name="file"; filename="t.csv"\\r\\nContent-Type: text/csv\\r\\n\\r\\n'
chunks = iter([head, *([b"NAME-OF-THE-PATIENT," * 3000] * 50)])

async def receive():
    chunk = next(chunks, None)
    if chunk is None:
        print("here", flush=True)
        await asyncio.sleep(600)
    return {"type": "http.request", "body": chunk, "more_body": True}

kind = (b"content-type", b"multipart/form-data; boundary=b")
scope = {"type": "http", "method": "POST", "path": "/", "query_string": b"", "headers": [kind]}
asyncio.run(EncryptedForm(scope, receive).form().__aenter__())
"""


def test_what_the_parser_of_the_form_puts_aside_is_encrypted(fresh_database: str) -> None:
    with subprocess.Popen([sys.executable, "-c", FORM], cwd=ROOT, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        assert process.stdout.readline() == b"here\n", "the form is in its middle"
        assert_open_files_show_nothing(process)
        process.kill()


def test_the_routes_of_uploads_read_their_forms_encrypted(
    client: TestClient, participant_code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    made: list[object] = []
    monkeypatch.setattr(forms, "raw_stream", lambda: made.append(raw := raw_bytes.raw_stream()) or raw)
    for path in ("/api/v1/uploads", f"/participants/{participant_code}/upload"):
        table = b"t_s,beta,amplitude_fraction\n" + b"".join(b"%d,1,1\n" % (2 * k) for k in range(20 + len(made)))
        fields = {"participant": participant_code, "visit": "1", "controller": "cdbs"}
        assert client.post(path, data=fields, files={"file": ("t.csv", table)}).status_code in (200, 201, 303), path
    assert [stream.closed for stream in made] == [True, True]


def test_a_disk_that_fills_while_a_form_comes_is_named(client: TestClient, participant_code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    full = lambda: raw_bytes._stream(open("/dev/full", "r+b", buffering=0), bytes(32))  # noqa: E731, SIM115 - its reader closes it
    monkeypatch.setattr(forms, "raw_stream", full)
    for path in ("/api/v1/uploads", f"/participants/{participant_code}/upload"):
        fields = {"participant": participant_code, "visit": "1", "controller": "cdbs"}
        answer = client.post(path, data=fields, files={"file": ("t.csv", b"1" * (1 << 20))}, headers={"accept": "text/html"})
        assert answer.status_code == 507, path
        assert "There is no room left on the disk." in answer.text
