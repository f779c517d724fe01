"""Time until the service has drawn a session of many raw samples, and each stretch that a reader zooms to.

The session is uploaded as a table. The first request of its chart decodes the file in a child, which writes extremes per bin of time (a
min-max pyramid) and the spectrogram; every later one reads what is in its window.
"""

from __future__ import annotations

import os
import tempfile
import time
from typing import Any

import numpy as np
from fastapi.testclient import TestClient

from app.accounts import service as accounts
from app.accounts.permissions import SYSTEM
from app.main import create_app
from app.platform.database import transaction
from app.platform.upkeep.migrate import migrate
from app.settings import get_settings
from app.study.participation import ParticipantIn, enrol
from app.tables.accounts import Role

RATE_HZ, LEAD_S = 250, 20
EMAIL = "admin@clinic.example"


def table(samples: int) -> bytes:
    """Write samples with a beta rhythm, from before the session on; times in s."""
    rng = np.random.default_rng(1)
    t = (np.arange(samples) - LEAD_S * RATE_HZ + 1) / RATE_HZ
    values = 4 * np.sin(2 * np.pi * 20 * t) + rng.standard_normal(samples)
    return ("t_s,lfp [uV],amplitude_ma\n" + "".join(f"{a:.3f},{b:.3f},2.0\n" for a, b in zip(t, values, strict=True))).encode()


def windows(duration_s: float, count: int) -> list[tuple[float, float]]:
    """Draw stretches as a reader zooms: from the whole session down to two seconds, at drawn places."""
    rng = np.random.default_rng(2)
    widths = np.geomspace(duration_s, 2.0, count)
    begins = [float(rng.uniform(0, duration_s - width)) if width < duration_s else 0.0 for width in widths]
    return [(begin, begin + float(width)) for begin, width in zip(begins, widths, strict=True)]


def measured(client: TestClient, address: str, **params: float) -> tuple[float, float, int]:
    """Measure milliseconds by the clock and of the processor, and bytes of an answer."""
    cpu, wall = time.process_time(), time.perf_counter()
    answer = client.get(address, params=params)
    if answer.status_code != 200:
        raise SystemExit(f"{address} answered {answer.status_code}: {answer.text}")
    return 1000 * (time.perf_counter() - wall), 1000 * (time.process_time() - cpu), len(answer.content)


def raw_samples(samples: int, count: int) -> dict[str, Any]:
    """Upload a session of so many samples to a service of its own, look at it once, then at `count` stretches.

    Returns:
        Milliseconds of the first request by this machine's clock, of later ones by the clock (median and 95th percentile) and of the
        processor, and the largest answer in kB.
    """
    with tempfile.TemporaryDirectory(prefix="betaloop-raw-") as folder:
        os.environ["BETALOOP_DATA_DIR"] = folder
        get_settings.cache_clear()
        migrate()
        with transaction("bench") as db:
            accounts.add_user(db, EMAIL, Role.ADMIN, "samples of a long session")
            settings = {"cdbs_amplitude_ma": 3.0, "beta_unit": "uV", "xi_beta": 1.0}
            enrol(db, ParticipantIn.model_validate({"code": "P1", "settings": settings}), SYSTEM)
            db.flush()
            token = accounts.create_token(db, EMAIL, "bench")
        with TestClient(create_app(), headers={"Authorization": f"Bearer {token}"}) as client:
            client.post("/api/v1/participants/P1/visits", json={"number": 1, "date": "2026-03-02"}).raise_for_status()
            stated = {"participant": "P1", "visit": "1", "controller": "cdbs"}
            sent = client.post("/api/v1/uploads", data=stated, files={"file": ("lfp.csv", table(samples))})
            if not sent.is_success:
                raise SystemExit(f"the upload answered {sent.status_code}: {sent.text}")
            return figures(client, int(sent.json()["sessions"][0]["id"]), samples, count)


def figures(client: TestClient, session: int, samples: int, count: int) -> dict[str, Any]:
    """Compute what `raw_samples` returns."""
    address = f"/sessions/{session}/signal.json"
    first, _, largest = measured(client, address)
    later = [measured(client, address, begin_s=b, end_s=e) for b, e in windows(samples / RATE_HZ - LEAD_S, count)]
    walls = [wall for wall, _, _ in later]
    return {
        "samples": samples,
        "first_ms": round(first),
        "later_median_ms": round(float(np.median(walls)), 1),
        "later_p95_ms": round(float(np.percentile(walls, 95)), 1),
        "later_cpu_ms": round(float(np.median([cpu for _, cpu, _ in later])), 1),
        "largest_kb": round(max(largest, *(size for _, _, size in later)) / 1000, 1),
    }
