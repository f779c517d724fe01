"""Whatever a study holds, every page and answer of the analyses opens, says what is missing, and shows no number that is none."""

from __future__ import annotations

import csv
import html
import io
import json
import re
from dataclasses import dataclass, replace
from functools import cache
from itertools import count
from typing import Any

import pytest
from fastapi.routing import iter_route_contexts
from fastapi.testclient import TestClient
from hypothesis import HealthCheck, Phase, example, given, settings
from hypothesis import strategies as st
from sqlalchemy.orm import Session

from app.main import create_app
from tests.app.analysis.conftest import adder

NAN = float("nan")
KEYS = ("rl", "random")
NO_NUMBER = re.compile(r"(?<![\w.])(?:[Nn]a[Nn]|[+-]?[Ii]nf(?:inity)?|None|undefined)(?![\w.])")


@dataclass(frozen=True)
class Given:
    """One session as the store's helper takes it."""

    visit: int = 1
    controller: str = "cdbs"
    beta: float | None = 2.0
    fraction: float | None = 1.0
    grasp: float | None = 2.4
    rating: int | None = 7
    tremor: float | None = 10.0
    stopped: str | None = None
    excluded: str | None = None
    medication_h: float | None = None

    def fields(self) -> dict[str, Any]:
        """Return the arguments of the helper."""
        return dict(vars(self))


def both(visits: int, each: int = 2, **fields: Any) -> list[Given]:
    """Build visits with both arms, the same values in every session."""
    return [Given(visit=v, controller=c, **fields) for v in range(1, visits + 1) for _ in range(each) for c in ("cdbs", "rl")]


EMPTY = {"beta": None, "fraction": None, "grasp": None, "rating": None, "tremor": None}
TIED = both(6)
ONE_ARM_A_VISIT = [Given(visit=v, controller="rl" if v % 2 else "cdbs", grasp=2.0 + 0.1 * v) for v in range(1, 7)]

sessions = st.lists(
    st.builds(
        Given,
        visit=st.integers(1, 4),
        controller=st.sampled_from(("cdbs", "cdbs", "rl", "distilled", "random", "no_dbs")),
        beta=st.sampled_from((None, NAN, 0.0, 2.0, 2.5, 1e-30, 1e30)),
        fraction=st.sampled_from((None, NAN, 0.0, 0.5, 1.0, 1.5)),
        grasp=st.sampled_from((None, 0.0, 2.4, 2.5, 3.0)),
        rating=st.sampled_from((None, 1, 7, 8, 10)),
        tremor=st.sampled_from((None, 0.0, 10.0, 12.5, 100.0)),
        stopped=st.sampled_from((None, None, None, "felt dizzy")),
        excluded=st.sampled_from((None, None, None, "cable fell off")),
        medication_h=st.sampled_from((None, 0.0, 1.0, 3.5)),
    ),
    max_size=24,
)


@cache
def addresses() -> tuple[str, ...]:
    """List every address of the analyses that can be read, with `CODE` for the participant, each controller and each format filled in."""
    app = create_app()
    answers = app.openapi()["paths"]
    paths = {c.path for c in iter_route_contexts(app.routes) if c.path and "GET" in (getattr(c, "methods", None) or ())}
    made = []
    for path in sorted(p for p in paths if "/analyses" in p or p == "/trial-time"):
        named = path.replace("{code}", "CODE")
        keyed = re.sub("{key}|{controller}", "{key}", named)
        own = [keyed.replace("{key}", key) for key in KEYS] if "{key}" in keyed else [named]
        parameters = answers.get(path, {}).get("get", {}).get("parameters", [])
        formats = [f for p in parameters if p["name"] == "format" for f in p["schema"]["enum"]]
        stated = "".join(f"&{p['name']}=1" for p in parameters if p["in"] == "query" and p["required"])
        made += [f"{p}?format={f}{stated}" for p in own for f in formats] or own
    return tuple(made)


def no_such_number(constant: str) -> float:
    raise ValueError(f"{constant} in JSON")


def wrong(kind: str, text: str) -> str:
    """Find the first invalid number, in whatever form the answer has; empty where there is none."""
    try:
        if kind.startswith("application/"):
            json.loads(text, parse_constant=no_such_number)
            return ""
        for embedded in re.findall(r'<script type="application/json">(.*?)</script>', text, re.DOTALL):
            json.loads(embedded, parse_constant=no_such_number)
    except ValueError as error:
        return str(error)
    if kind.startswith("text/csv"):
        cells = [cell for row in csv.reader(io.StringIO(text)) for cell in row]
        return next((c for c in cells if NO_NUMBER.fullmatch(c)), "")
    shown = html.unescape(re.sub(r"<script.*?</script>", " ", text, flags=re.DOTALL))
    shown = shown if "svg" in kind else re.sub(r"<[^>]*>", " ", shown)
    found = NO_NUMBER.search(shown)
    return shown[max(found.start() - 80, 0) : found.end() + 80] if found else ""


def problems(client: TestClient, expected: dict[str, int]) -> dict[str, str]:
    """List what is wrong with the answers at these addresses, each with the status that it should have."""
    found = {}
    for path, status in expected.items():
        answer = client.get(path)
        if answer.status_code != status:
            found[path] = f"{answer.status_code}: {answer.text[-300:]}"
        elif problem := wrong(answer.headers["content-type"], answer.text):
            found[path] = problem
    return found


@pytest.mark.slow
def test_any_study_gets_sentences(client: TestClient, db: Session, participant_code: str, monkeypatch: pytest.MonkeyPatch) -> None:
    numbers = count(1)
    really = db.commit
    assert {"/analyses", "/api/v1/analyses?format=svg", "/participants/CODE/analyses/models/rl", "/trial-time"} <= set(addresses())
    assert any("/analyses/battery?format=csv&" in a for a in addresses())
    assert "{" not in "".join(addresses())

    @settings(
        max_examples=3, deadline=None, derandomize=True, phases=(Phase.explicit, Phase.generate),
        suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
    )  # fmt: skip
    @given(sessions)
    @example([])
    @example([Given(controller="rl")])
    @example(TIED)
    @example(both(1))
    @example(ONE_ARM_A_VISIT)
    @example(both(3, **EMPTY))
    @example([replace(s, fraction=0.0, grasp=0.0, rating=1, tremor=0.0) for s in TIED])
    @example([replace(s, stopped="felt dizzy") for s in both(4)])
    @example([replace(s, beta=NAN, fraction=NAN) for s in TIED])
    def of(study: list[Given]) -> None:
        code = f"S{next(numbers)}"
        body = {"code": code, "settings": {"cdbs_amplitude_ma": 3.0, "beta_unit": "uV", "beta_source": "table"}}
        assert client.post("/api/v1/participants", json=body).status_code == 201
        with monkeypatch.context() as patched:
            patched.setattr(db, "commit", db.flush)
            add = adder(db, code)
            for session in study:
                add(**session.fields())
        really()
        present = {s.controller for s in study if s.excluded is None}
        own = [(a.replace("CODE", code), next((k for k in KEYS if f"/{k}" in a), None)) for a in addresses() if "CODE" in a]
        assert not problems(client, {path: 404 if key is not None and key not in present else 200 for path, key in own})
        primary = client.get(f"/api/v1/participants/{code}/analyses/primary").json()
        for result in primary["results"]:
            for c in result["comparisons"]:
                assert (c["primary"]["estimate"] is None) == bool(c["primary"]["text"]), c
        for verdict in primary["verdicts"]:
            assert verdict["sentence"].endswith("."), verdict

    of()
    # all of these participants together
    assert not problems(client, {a: 200 for a in addresses() if "CODE" not in a})
