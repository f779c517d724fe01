"""Outcomes that a study adds by a file: their path from the entry form to the primary analysis. Run as a program by its test."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import tempfile
import zipfile
from pathlib import Path
from typing import Any

DEFINITIONS = """outcomes:
  - key: balance_score
    label: Balance score
    short: Balance
    noun: balance
    unit: of 56
    low: 0
    high: 56
    whole: true
    better: higher
    help: Berg balance scale.
    margin: {points: 4}
  - use: mds_updrs_iii
    margin: {points: 5}
{judged}"""


def main(token: str) -> dict[str, Any]:
    """Enter, show, export and analyse the outcome; return what was seen."""
    from fastapi.testclient import TestClient

    from app.main import create_app
    from app.platform import database
    from app.platform.upkeep import doctor
    from app.platform.upkeep.migrate import migrate
    from tests.app.analysis.conftest import adder

    migrate()
    migrate()  # what is there already is not added again
    client = TestClient(create_app(), headers={"Authorization": f"Bearer {token}"})
    settings = {"xi_beta": 1.0, "cdbs_amplitude_ma": 3.0, "beta_unit": "uV", "beta_source": "table"}
    assert client.post("/api/v1/participants", json={"code": "P1", "settings": settings}).status_code == 201
    numbers = []
    with database.new_session() as db:
        database.set_actor(db, "test")
        add = adder(db, "P1")
        for visit in (1, 2, 3, 4):
            for k, controller in enumerate(("cdbs", "rl", "cdbs", "rl")):
                fraction = 0.6 + 0.01 * k if controller == "rl" else 1.0
                own = {"grasp": 2.4 + 0.05 * visit + 0.01 * k, "rating": 7 + (k + visit) % 2, "tremor": 5.0 + k + visit}
                last = (visit, k) == (4, 3)
                session = add(controller, fraction=fraction, visit=visit, stopped="dizzy" if last else None, **own)
                numbers.append((session, 40 + visit - k % 2 * (2 if k < 2 else 1)))
    html = {"Accept": "text/html"}
    first, value = numbers[0]
    form = client.get(f"/sessions/{first}", headers=html).text
    entered = client.post(f"/sessions/{first}/qoc", data={"revision": "1", "balance_score": str(value), "reason": "measured"}, headers=html)
    for session, score in numbers[1:]:
        body = {"balance_score": score, "mds_updrs_iii": 100 - score, "reason": "measured"}
        assert client.put(f"/api/v1/sessions/{session}/qoc", json=body).status_code == 200
    refused = client.put(f"/api/v1/sessions/{first}/qoc", json={"balance_score": 57, "reason": "typed"})
    primary = client.get("/api/v1/participants/P1/analyses/primary").json()
    changed = client.put("/api/v1/participants/P1/margins", json={"margins": {"balance_score_margin": 3}, "reason": "protocol"})
    visit_of_first = client.get(f"/api/v1/sessions/{first}").json()["visit_id"]
    with tempfile.TemporaryDirectory() as folder:
        content = client.get("/participants/P1/export.zip").content
        zipfile.ZipFile(io.BytesIO(content)).extractall(folder)
        package = Path(folder) / "P1"
        again = subprocess.run([sys.executable, "-I", str(package / "recompute.py")], capture_output=True, text=True, check=False)
        tables = {name: (package / f"{name}.csv").read_text() for name in ("sessions", "outcomes", "margins", "noninferiority")}
    return {
        "form": form,
        "entered": [entered.status_code, entered.text[:300]],
        "stored": client.get(f"/api/v1/sessions/{first}").json()["qoc"],
        "refused": [refused.status_code, refused.text],
        "document": client.get("/api/v1/openapi.json").json()["components"]["schemas"]["QocIn"],
        "visit": client.get(f"/visits/{visit_of_first}", headers=html).text,
        "margins": [changed.status_code, changed.json(), client.get("/participants/P1/margins", headers=html).text],
        "primary": primary,
        "page": client.get("/participants/P1/analyses", headers=html).text,
        "five": client.get("/api/v1/participants/P1/analyses").json(),
        "tables": tables,
        "recomputed": [again.returncode, again.stdout + again.stderr],
        "scores": numbers,
        "earlier": client.get("/api/v1/participants/P0/margins").json()[-1],
        "checks": [[f.name, f.ok, f.detail] for f in doctor.examine(hashes=True)],
    }


def main_alone(token: str) -> dict[str, Any]:
    """Run the analysis of a study that measures MDS-UPDRS III and a rating alone. It judges by the first."""
    from fastapi.testclient import TestClient

    from app.main import create_app
    from app.platform import database
    from app.platform.upkeep.migrate import migrate
    from tests.app.analysis.conftest import adder
    from tests.conftest import PASSWORD

    migrate()
    client = TestClient(create_app(), headers={"Authorization": f"Bearer {token}"})
    settings = {"xi_beta": 1.0, "cdbs_amplitude_ma": 3.0, "beta_unit": "uV", "beta_source": "table"}
    assert client.post("/api/v1/participants", json={"code": "P2", "settings": settings}).status_code == 201
    with database.new_session() as db:
        database.set_actor(db, "test")
        add = adder(db, "P2")
        for visit in (1, 2, 3, 4, 5, 6):
            for k, controller in enumerate(("cdbs", "rl", "cdbs", "rl")):
                session = add(controller, fraction=0.6 + 0.01 * k if controller == "rl" else 1.0, visit=visit, rating=7)
                body = {"mds_updrs_iii": 30 + visit % 2 + 2 * (k % 2), "reason": "measured"}
                assert client.put(f"/api/v1/sessions/{session}/qoc", json=body).status_code == 200
    primary = client.get("/api/v1/participants/P2/analyses/primary").json()
    page = client.get("/participants/P2/analyses", headers={"Accept": "text/html"}).text
    locked = client.post("/api/v1/participants/P2/margins/locks", json={"version": 1, "reason": "protocol", "password": PASSWORD})
    return {
        "primary": primary,
        "locked": [locked.status_code, locked.json()],
        "page": page,
    }


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as place:
        file = Path(place) / "outcomes.yaml"
        file.write_text(DEFINITIONS.replace("{judged}", sys.argv[2]))
        os.environ["BETALOOP_OUTCOMES"] = str(file)
        sys.stdout.write(json.dumps(main_alone(sys.argv[1]) if sys.argv[2] else main(sys.argv[1])))
