"""Files as a clinic has them: recordings of the synthetic device, tables, and their uploads."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Callable
from datetime import UTC, datetime
from functools import cache
from typing import Any

import pytest
from fastapi.testclient import TestClient

from ml.population import rcs_session_zip, run_session

DAY = datetime(2026, 3, 2, 10, 0, tzinfo=UTC)
"""The day of visit 1 of participant P1."""
SERIALS = {"P1": "SYN000001H", "P2": "SYN000002H"}
"""P1's implant is on the right, P2's on the left."""


@cache
def device_zip(
    controllers: tuple[str, ...] = ("random",), who: str = "P1", minute: float = 0.0, steps: int = 30, gap_s: float = 60.0, seed: int = 3
) -> bytes:
    """Write an RC+S session folder as zip: one recording that starts `minute` minutes after ten, with one session per controller in it."""
    made = [
        run_session(who, c, visit=1, hour=1.0, seed=seed + i, steps=steps, lead_steps=10, resolution_ma=0.1)  # type: ignore[arg-type]
        for i, c in enumerate(controllers)
    ]
    started_ms = round(1000 * (DAY.timestamp() + 60 * minute))
    return rcs_session_zip(made, started_ms=started_ms, serial=SERIALS[who], gap_s=gap_s)


def loose(archive: bytes, folder: str = "") -> list[tuple[str, bytes]]:
    """List the files of an archive as a browser sends them when a folder is dropped."""
    with zipfile.ZipFile(io.BytesIO(archive)) as zipped:
        return [(f"{folder}{n.rsplit('/', 1)[1]}", zipped.read(n)) for n in zipped.namelist() if not n.endswith("/")]


def table(rows: list[tuple[float, float | str, float | str]], amplitude: str = "amplitude_fraction") -> bytes:
    """Write a table of steps."""
    return "\n".join([f"t_s,beta,{amplitude}", *(",".join(map(str, row)) for row in rows)]).encode() + b"\n"


def steady(level: float, steps: int = 20, beta: float = 1.0, amplitude: str = "amplitude_fraction") -> bytes:
    """Write a table with a constant amplitude; `beta` distinguishes two of them."""
    return table([(2 * k, beta, level) for k in range(steps + 1)], amplitude)


Send = Callable[..., Any]


@pytest.fixture
def send(client: TestClient, participant_code: str) -> Send:
    """Upload named files of P1 as one upload; fields are those of the form."""

    def post(*files: tuple[str, bytes], by: TestClient = client, **fields: Any) -> Any:
        data = {"participant": participant_code} | {k: str(v) for k, v in fields.items() if v is not None}
        return by.post("/api/v1/uploads", data=data, files=[("file", f) for f in files])

    return post


@pytest.fixture
def proposals(client: TestClient, participant_code: str) -> Callable[[], list[dict[str, Any]]]:
    """The proposals of P1 as the interface lists them."""
    return lambda: list(client.get(f"/api/v1/participants/{participant_code}/proposals").json())
