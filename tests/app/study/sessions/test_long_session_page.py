"""The page of a long session is still a small page."""

from __future__ import annotations

import io

import numpy as np
from fastapi.testclient import TestClient

LARGEST_KB = 60.0
"""What any page may take over the wire, 1000 bytes; the charts' library apart."""


def long_session(steps: int) -> bytes:
    """Write a table of so many steps of 2 s in which no two lines are alike, with a sensor's values: nothing that compresses well."""
    rng = np.random.default_rng(5)
    sink = io.StringIO()
    sink.write("t_s,beta,amplitude_fraction\n")
    for k in range(-10, steps):
        sink.write(f"{2 * (k + 1)},{rng.uniform(0.6, 1.9):.6f},{rng.uniform(0.3, 1.0):.4f}\n")
    return sink.getvalue().encode()


def test_the_page_of_eighty_minutes_travels_in_sixty_kilobytes(client: TestClient, participant_code: str) -> None:
    body = {"participant": participant_code, "visit": "1", "controller": "random"}
    sent = client.post("/api/v1/uploads", data=body, files={"file": ("s.csv", long_session(80 * 30))})
    assert sent.status_code == 201, sent.text
    address = f"/sessions/{sent.json()['sessions'][0]['id']}"
    with client.stream("GET", address, headers={"Accept": "text/html", "Sec-Fetch-Site": "same-origin"}) as page:
        sent_bytes = len(b"".join(page.iter_raw()))
    assert page.status_code == 200
    assert page.headers["content-encoding"] == "gzip"
    assert "2410 rows" in client.get(address, headers={"Accept": "text/html"}).text, "every step stands in the table behind the chart"
    assert sent_bytes / 1000 <= LARGEST_KB
