"""The clinic day on a tablet that reaches the service over a network: with TLS it keeps entries, without it keeps nothing."""

from __future__ import annotations

import base64
import hashlib
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.serialization import Encoding, NoEncryption, PrivateFormat, PublicFormat
from cryptography.x509.oid import NameOID

from tests.browser.conftest import FLAGS, Watched, program
from tests.clinic_day import ClinicDay, clinic_day
from tests.ports import free_port

__all__ = ["clinic_day"]
pytestmark = pytest.mark.browser
HOST = "clinic.example"
PATIENCE_S = 180.0
"""How long a service may take to start and to end on a machine that is busy with other work."""


@contextmanager
def served(certificate: Path, key: Path, log: Path) -> Iterator[str]:
    """Run `betaloop serve` with a certificate, in a process of its own, on the test's database."""
    port = free_port()
    command = ["serve", "--port", str(port), "--tls-certificate", str(certificate), "--tls-key", str(key)]
    with log.open("wb") as out:
        process = subprocess.Popen([sys.executable, "-c", "from app.cli import main; main()", *command], stdout=out, stderr=out)
    try:
        deadline = time.monotonic() + PATIENCE_S
        while not _listens(port):
            assert process.poll() is None, log.read_text()
            assert time.monotonic() < deadline, log.read_text()
            time.sleep(0.2)
        yield f"https://{HOST}:{port}"
    finally:
        process.terminate()
        process.wait(PATIENCE_S)


def _listens(port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex(("127.0.0.1", port)) == 0


@pytest.mark.slow
def test_over_tls_a_tablet_keeps_entries_and_opens_without_network(chromium: Any, clinic_day: ClinicDay, tmp_path: Path) -> None:
    certificate, key, pin = _certificate(tmp_path)
    flags = [*FLAGS, f"--host-resolver-rules=MAP {HOST} 127.0.0.1", f"--ignore-certificate-errors-spki-list={pin}"]
    launch = chromium.browser_type.launch_persistent_context
    with (
        served(certificate, key, tmp_path / "serve.log") as address,
        launch(str(tmp_path / "profile"), executable_path=program(), args=flags) as context,
    ):
        watched = Watched(context.new_page(), address)
        answer = context.request.get(f"{address.replace(HOST, '127.0.0.1')}/healthz", ignore_https_errors=True)
        assert "max-age" in answer.headers["strict-transport-security"]
        watched.sign_in()
        assert [c["secure"] for c in context.cookies() if c["name"] == "betaloop_session"] == [True]
        watched.open(f"/visit-day/{clinic_day.visit}")
        watched.page.wait_for_selector("#day[data-ready=yes]")
        watched.page.evaluate("() => navigator.serviceWorker.ready.then(() => true)")
        watched.page.wait_for_function("() => caches.match('/visit-day/shell').then(Boolean)")
        context.set_offline(True)
        watched.page.click("[data-act=start]")
        watched.page.wait_for_selector(".day-link[data-link=offline][data-waiting='1']")
        watched.page.reload()
        watched.page.wait_for_selector("section[data-state=running]")
        context.set_offline(False)
        watched.page.wait_for_selector(".day-link[data-link=online][data-waiting='0']")


def test_without_tls_nothing_is_kept_and_the_plain_form_remains(chromium: Any, address: str, clinic_day: ClinicDay, tmp_path: Path) -> None:
    flags = [*FLAGS, f"--host-resolver-rules=MAP {HOST} 127.0.0.1"]
    with chromium.browser_type.launch(executable_path=program(), args=flags) as browser:
        watched = Watched(browser.new_page(), address.replace("127.0.0.1", HOST))
        watched.sign_in()
        watched.open(f"/visit-day/{clinic_day.visit}")
        watched.page.wait_for_selector("text=Nothing can be kept on this tablet")
        for button in ("#plain >> text=Start", "#plain button[value='8']"):
            with watched.page.expect_navigation():
                watched.page.click(button)
        assert watched.page.evaluate("() => indexedDB.databases().then((all) => all.length)") == 0
    kinds = [e["kind"] for e in clinic_day.client.get(f"/api/v1/visits/{clinic_day.visit}/day/entries").json()["items"]]
    assert kinds == ["start", "rating"]


def _certificate(folder: Path) -> tuple[Path, Path, str]:
    """Make a certificate of its own maker for the host, its key, and the hash by which the browser trusts it."""
    key, name = ec.generate_private_key(ec.SECP256R1()), x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, HOST)])
    now = datetime.now(UTC)
    builder = x509.CertificateBuilder(
        name, name, key.public_key(), x509.random_serial_number(), now - timedelta(days=1), now + timedelta(days=2)
    )
    made = builder.add_extension(x509.SubjectAlternativeName([x509.DNSName(HOST)]), critical=False).sign(key, hashes.SHA256())
    (folder / "chain.pem").write_bytes(made.public_bytes(Encoding.PEM))
    (folder / "key.pem").write_bytes(key.private_bytes(Encoding.PEM, PrivateFormat.PKCS8, NoEncryption()))
    public = key.public_key().public_bytes(Encoding.DER, PublicFormat.SubjectPublicKeyInfo)
    return folder / "chain.pem", folder / "key.pem", base64.b64encode(hashlib.sha256(public).digest()).decode()
