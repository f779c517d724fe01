"""The data package: its dictionary is true, no date leaves, and its own script recomputes the primary tables."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import re
import subprocess
import sys
import zipfile
from collections.abc import Callable
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from tests.app.analysis.conftest import add_session, add_visits  # noqa: F401 (fixtures)
from tests.conftest import PASSWORD

CHECKS = {"integer": r"-?\d+", "number": r"-?[\d.]+(e-?\d+)?", "boolean": "true|false", "string": r"[\s\S]*"}


@pytest.fixture
def package(client: TestClient, add_visits: Callable[..., None], add_session: Callable[..., int], tmp_path: Path) -> Path:  # noqa: F811
    """P1 with six visits, a failure, an excluded session, ties, another beta and a locked margin, unpacked."""
    add_visits(2)
    assert (
        client.post("/api/v1/participants/P1/margins/locks", json={"version": 1, "reason": "protocol", "password": PASSWORD}).status_code
        == 201
    )
    add_visits(4, first=3, seed=9)
    add_session("rl", fraction=0.3, stopped="tremor", visit=4)
    add_session("rl", fraction=0.3, excluded="cable", visit=4, grasp=90 / 7)
    add_session("distilled", fraction=0.8, grasp=2.0, rating=5, tremor=20.0, visit=5)
    add_session("cdbs", beta=900.0, unit="device units", source="device_power", visit=6)
    answer = client.get("/participants/P1/export.zip")
    assert answer.status_code == 200
    with zipfile.ZipFile(io.BytesIO(answer.content)) as archive:
        archive.extractall(tmp_path)
    return tmp_path / "P1"


def run(package: Path) -> subprocess.CompletedProcess[str]:
    # -I: without the working directory and the environment, so that nothing of betaloop can be imported by accident
    return subprocess.run([sys.executable, "-I", str(package / "recompute.py")], capture_output=True, text=True, check=False)


def test_its_own_script_recomputes_the_primary_tables_without_betaloop(package: Path) -> None:
    source = (package / "recompute.py").read_text()
    used = set(re.findall(r"^(?:from|import) (\w+)", source, re.M))
    assert used <= {"__future__", "csv", "math", "sys", "collections", "pathlib", "typing", "numpy", "scipy"}
    done = run(package)
    assert done.returncode == 0, done.stdout + done.stderr
    assert "all agree" in done.stdout
    primary = list(csv.DictReader((package / "primary.csv").open()))
    again = {(r["controller"], r["metric"]): r for r in csv.DictReader((package / "recomputed.csv").open())}
    compared = [r for r in primary if r["estimate"] and not r["policy_id"]]
    assert len(compared) >= 5
    for row in compared:
        assert float(again[(row["controller"], row["metric"])]["estimate"]) == pytest.approx(float(row["estimate"]), abs=1e-9)
    outcomes = list(csv.DictReader((package / "noninferiority.csv").open()))
    assert {(r["confirmatory"], r["outcome"]) for r in outcomes} >= {("true", "grasp"), ("true", "rating"), ("true", "tremor")}


def test_a_number_that_was_changed_is_found(package: Path) -> None:
    path = package / "sessions.csv"
    rows = list(csv.DictReader(path.open()))
    rows[1]["rating_1_10"] = "1"
    with path.open("w", newline="") as file:
        out = csv.DictWriter(file, rows[0])
        out.writeheader()
        out.writerows(rows)
    done = run(package)
    assert done.returncode == 1
    assert "rl rating estimate" in done.stdout


def test_a_verdict_that_was_changed_is_named_with_the_margins_that_it_went_by(package: Path) -> None:
    path = package / "noninferiority.csv"
    rows = list(csv.DictReader(path.open()))
    judged = next(r for r in rows if r["estimate"])
    other = {**judged, "margins_version": "7", "estimate": str(float(judged["estimate"]) + 1)}
    with path.open("w", newline="") as file:
        out = csv.DictWriter(file, rows[0])
        out.writeheader()
        out.writerows([*rows, other])
    (line,) = run(package).stdout.splitlines()
    named = f"{other['controller']} {other['outcome']} (margins_version 7, confirmatory {other['confirmatory']}) estimate: "
    assert line.startswith(named), line


def test_the_dictionary_describes_every_column_and_every_file(package: Path) -> None:
    described = json.loads((package / "datapackage.json").read_text())
    assert {r["path"] for r in described["resources"]} == {p.name for p in package.glob("*.csv")}
    for resource in described["resources"]:
        content = (package / resource["path"]).read_bytes()
        assert resource["hash"] == f"sha256:{hashlib.sha256(content).hexdigest()}"
        rows = list(csv.reader(io.StringIO(content.decode())))
        fields = resource["schema"]["fields"]
        assert rows[0] == [f["name"] for f in fields]
        assert all(f["description"] for f in fields)
        for row in rows[1:]:
            for field, cell in zip(fields, row, strict=True):
                assert cell == "" or re.fullmatch(CHECKS[field["type"]], cell), (resource["path"], field["name"], cell)


def test_no_date_leaves(package: Path) -> None:
    for file in package.iterdir():
        if file.name != "recompute.py":
            assert not re.search(r"20\d\d-\d\d-\d\d", file.read_text()), file.name
    visits = list(csv.DictReader((package / "visits.csv").open()))
    assert int(visits[1]["day"]) - int(visits[0]["day"]) == 28
