"""Entries of a large study for measuring pages besides its rows, made as people make them: through the REST interface of the service."""

from __future__ import annotations

import datetime as dt
import json
from typing import Any

import numpy as np
from fastapi.testclient import TestClient

from app.accounts import repository
from app.accounts import service as accounts
from app.platform.database import transaction
from app.tables.accounts import Role

LFP_HZ, LFP_MINUTES, TREND_DAYS = 250, 10, 60
STEPS_OF_A_PROPOSAL = 300
DRAFTER = "neurologist@clinic.example"
WHY_UNSAFE = "A plan of every participant is measured, whatever the verdict."


def callers(app: Any, admin: str) -> tuple[TestClient, TestClient]:
    """Make a signer and a drafter, both with tokens."""
    with transaction("bench") as db:
        if not any(u.email == DRAFTER for u in repository.users(db)):
            accounts.add_user(db, DRAFTER, Role.CLINICIAN, "pages of a large study")
        tokens = [accounts.create_token(db, email, "bench") for email in (admin, DRAFTER)]
    first, second = (TestClient(app, headers={"Authorization": f"Bearer {token}"}) for token in tokens)
    return first, second


def complete(signer: TestClient, drafter: TestClient, code: str, password: str, visit: int, policies: list[int]) -> dict[str, Any]:
    """Enter a session with samples, a proposal, a table of unknown columns, a device's history, an approved plan with a day, events,
    questions.

    Args:
        signer, drafter: who calls. code: of the participant. password: the signer's. visit: number of the newest visit.
        policies: two that the plan tests.

    Returns:
        Values in the paths of pages: `signal`, `upload`, `proposal`, `file`, `planned`.
    """
    rng = np.random.default_rng(visit + sum(code.encode()))
    drawn = _upload(signer, code, ("lfp.csv", _samples(rng)), visit=str(visit), controller="other")
    session = drawn["sessions"][0]["id"]
    proposed = _upload(signer, code, ("steps.csv", _steps(rng)), visit=str(visit))
    unknown = _upload(signer, code, ("more.csv", _steps(rng)), ("u.csv", _unknown(rng)), visit=str(visit), controller="other")
    _upload(signer, code, ("report.json", _report(rng)))
    for field, text in (("rating", "7 in the file, 8 on the form?"), ("grasp_hz", "of which hand?")):
        _send(signer, f"/participants/{code}/data-queries", json={"session_id": session, "field": field, "text": text})
    for severity in ("mild", "severe"):
        event = {"kind": "speech", "severity": severity, "serious": False}
        _send(signer, f"/participants/{code}/adverse-events", json=event)
    day = f"{dt.datetime.now(dt.UTC):%Y-%m-%d}"
    planned = _send(signer, f"/participants/{code}/visits", json={"number": visit + 1, "date": day})["id"]
    for policy in policies:
        _send(signer, f"/policies/{policy}/release", json={"password": password})
    draft = {"policy_ids": policies, "random_sessions": 1, "seed": 1, "min_ma": 0.0, "max_ma": 3.0, "ramp_ma_per_s": 1.5}
    draft["overrides"] = [{"policy_id": policy, "reason": WHY_UNSAFE} for policy in policies]
    _send(drafter, f"/visits/{planned}/plan", json=draft)
    _send(signer, f"/visits/{planned}/plan/approve", json={"password": password})
    waiting = next(f["id"] for f in unknown["files"] if f["waits_for_mapping"])
    return {
        "signal": session, "upload": drawn["id"], "proposal": proposed["proposals"][0]["session"]["id"], "file": waiting,
        "planned": planned,
    }  # fmt: skip


def _send(client: TestClient, path: str, **form: Any) -> Any:
    answer = client.post(f"/api/v1{path}", **form)
    if not answer.is_success:
        raise SystemExit(f"{path} answered {answer.status_code}: {answer.text}")
    return answer.json() if "json" in answer.headers.get("content-type", "") else None


def _upload(client: TestClient, code: str, *files: tuple[str, bytes], **stated: str) -> Any:
    return _send(client, "/uploads", data={"participant": code, **stated}, files=[("file", f) for f in files])


def _samples(rng: np.random.Generator) -> bytes:
    """Write a table of raw samples with a beta rhythm, from 20 s before its session on."""
    t = (np.arange(-20 * LFP_HZ, 60 * LFP_MINUTES * LFP_HZ) + 1) / LFP_HZ
    lfp = 4 * np.sin(2 * np.pi * 20 * t) + rng.standard_normal(t.size)
    return ("t_s,lfp [uV],amplitude_ma\n" + "".join(f"{a:.3f},{b:.3f},2.0\n" for a, b in zip(t, lfp, strict=True))).encode()


def _steps(rng: np.random.Generator) -> bytes:
    beta = np.abs(rng.normal(1.2, 0.3, STEPS_OF_A_PROPOSAL))
    return ("t_s,beta,amplitude_fraction\n" + "".join(f"{2 * k},{b:.4f},1\n" for k, b in enumerate(beta))).encode()


def _unknown(rng: np.random.Generator) -> bytes:
    signal = rng.normal(1.2, 0.3, STEPS_OF_A_PROPOSAL)
    return ("Zeit;Signal;Strom\n" + "".join(f"{2 * k + 2};{v:.3f};1.5\n" for k, v in enumerate(signal))).encode()


def _report(rng: np.random.Generator) -> bytes:
    """Write a report of a device with a trend of two months."""
    begin = dt.datetime(2026, 2, 1, tzinfo=dt.UTC)

    def at(minutes: int) -> str:
        return f"{begin + dt.timedelta(minutes=minutes):%Y-%m-%dT%H:%M:%SZ}"

    last = TREND_DAYS * 144
    power = rng.integers(80, 400, last).tolist()
    averages = [{"DateTime": at(10 * k), "LFP": p, "AmplitudeInMilliAmps": 2.0} for k, p in enumerate(power)]
    program = {"AmplitudeInMilliAmps": 2.4, "PulseWidthInMicroSecond": 60, "RateInHertz": 130}
    group = {
        "GroupId": "GroupIdDef.GROUP_A", "ActiveGroup": True,
        "ProgramSettings": {"RateInHertz": 130, "LeftHemisphere": {"Programs": [program]}},
    }  # fmt: skip
    content = {
        "SessionDate": at(10 * last),
        "DeviceInformation": {"Initial": {"DeviceDateTime": at(10 * last)}},
        "Groups": {"Final": [group]},
        "DiagnosticData": {"LFPTrendLogs": {"HemisphereLocationDef.Left": {at(10 * last): averages}}},
    }
    return json.dumps(content).encode()
