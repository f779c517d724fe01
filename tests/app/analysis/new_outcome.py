"""An outcome that a study adds: its record, and its path from the entry form to the primary analysis. Its test runs this as a program.

The record is put into `ml/outcomes.py` before anything else is imported. Nothing else of the code is changed; the columns are those of its
migration.
"""

from __future__ import annotations

import io
import json
import subprocess
import sys
import tempfile
import types
import zipfile
from pathlib import Path
from typing import Any

import ml

RECORD = """    Outcome(
        key="balance", field="balance_score", column="balance_0_56", label="Balance score", short="Balance", noun="balance",
        the_noun="balance", unit="of 56", entry_unit="of 56", sentence_unit="of 56", difference_unit="points", difference_words="points",
        contrast_unit="points", worse="lower", help="Berg balance scale.", explained="Berg balance scale, 0 worst to 56 best.",
        description="Berg balance scale, 0-56.", exported="Berg balance scale, newest revision.", low=0.0, high=56.0, whole=True,
        decimals=1, mean_decimals=1, higher_is_better=True, failure=None, resolution=1.0, bounded=True,
        margin=Margin(
            field="balance_points", kind="points", default=4.0, least=0.5, most=20, unit="points", label="Balance lower by",
            help="On the scale of 0 to 56.", form_unit="points", description="Balance may be lower by this many points.",
        ),
    ),
"""
END = ')\n"""Every outcome, in the order'
MIGRATION = (
    "alter table qoc add column balance_score smallint check (balance_score between 0 and 56)",
    "alter table margins_version add column balance_points double precision not null default 4",
)


def main(token: str) -> dict[str, Any]:
    """Enter, show, export and analyse the outcome; return what was seen."""
    from fastapi.testclient import TestClient
    from sqlalchemy import create_engine, text

    from app.main import create_app
    from app.platform import database
    from tests.app.analysis.conftest import adder

    with create_engine(database.owner_url()).begin() as connection:
        for statement in MIGRATION:
            connection.execute(text(statement))
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
        assert client.put(f"/api/v1/sessions/{session}/qoc", json={"balance_score": score, "reason": "measured"}).status_code == 200
    refused = client.put(f"/api/v1/sessions/{first}/qoc", json={"balance_score": 57, "reason": "typed"})
    primary = client.get("/api/v1/participants/P1/analyses/primary").json()
    changed = client.put("/api/v1/participants/P1/margins", json={"margins": {"balance_points": 3}, "reason": "protocol"})
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
    }


def add_record() -> None:
    """Load `ml.outcomes` with one more record."""
    path = Path(ml.__path__[0]) / "outcomes.py"
    source = path.read_text()
    assert source.count(END) == 1
    module = sys.modules["ml.outcomes"] = types.ModuleType("ml.outcomes")
    exec(compile(source.replace(END, RECORD + END), str(path), "exec"), module.__dict__)


if __name__ == "__main__":
    add_record()
    sys.stdout.write(json.dumps(main(sys.argv[1])))
