"""The page of the audit trail."""

from __future__ import annotations

from fastapi.testclient import TestClient


def test_it_shows_a_proposal_whose_controller_nobody_has_stated(client: TestClient, participant_code: str) -> None:
    table = "t_s,beta,amplitude_fraction\n" + "".join(f"{2 * k},1,0.5\n" for k in range(-9, 41))
    sent = client.post("/api/v1/uploads", data={"participant": participant_code, "visit": "1"}, files={"file": ("one.csv", table.encode())})
    assert [p["session"]["controller"] for p in sent.json()["proposals"]] == [None]
    page = client.get("/audit", headers={"Accept": "text/html"})
    assert page.status_code == 200
    assert "proposed session 1 of visit 1 of P1" in page.text
