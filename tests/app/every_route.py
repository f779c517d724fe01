"""A study in which every route of the REST interface has a row to work on, with a call that is right for each."""

from __future__ import annotations

import pickle
from base64 import b64decode, b64encode
from datetime import UTC, datetime
from typing import Any

from fastapi.routing import iter_route_contexts
from fastapi.testclient import TestClient

from app.accounts import service as accounts
from app.analysis.energy import ImplantIn
from app.learning.policies import constant_onnx
from app.main import DESCRIPTION
from app.platform.database import transaction
from app.tables.accounts import Role
from app.tables.learning import Policy
from tests.app.filled_study import FilledStudy
from tests.app.ingest.test_clocks import report as percept_report
from tests.app.planning.bundles.port_answers import port_answers
from tests.app.planning.found_rule import add_found_rule

MAPPING = {
    "name": "two columns",
    "header_line": 1,
    "holds": "steps",
    "time_format": "seconds",
    "time_at": "end",
    "columns": [
        {"number": 1, "role": "time"},
        {"number": 2, "role": "beta", "unit": "uV"},
        {"number": 3, "role": "amplitude_ma", "unit": "mA"},
    ],
}
Json = dict[str, Any]
OWN = ("file_id", "event_id", "query_id", "dose_id", "mapping_id")
"""Members of paths whose rows each route has for itself."""
TABLE = b"t_s,beta,amplitude_fraction\n" + b"".join(b"%d,1,1\n" % (2 * k) for k in range(21))
SAMPLES = b"t_s,lfp [uV],amplitude_ma\n" + b"".join(b"%.3f,%d,1\n" % (k / 250, k * k % 17) for k in range(-5000, 5001))
GRASPS = b"t_s\n" + b"".join(b"%.2f\n" % (0.4 * k) for k in range(11))
SPEECH = {"kind": "speech", "severity": "severe", "serious": True}
DOSE = {"drug": "levodopa", "mg": 100, "taken_at": "2026-03-02T07:00:00Z"}
RATED = {
    "uuid": "0b6e2a8c-6f43-4c58-9d3a-2f1a7f4f0c11", "kind": "rating", "payload": {"value": 7}, "device_time": "2026-11-22T10:00:00Z",
}  # fmt: skip
PASSWORD = "a password of the test"


METHODS = ("get", "post", "put", "patch", "delete")


def routes(app: Any) -> list[tuple[str, str]]:
    """List (method, path) of every route of the REST interface, as the service has them, but its own description."""
    found = [(m.lower(), c.path) for c in iter_route_contexts(app.routes) if c.path for m in sorted(getattr(c, "methods", None) or ())]
    return [(m, p) for m, p in found if m in METHODS and p.startswith(("/api/", "/healthz", "/readyz")) and p != DESCRIPTION]


def token_of(role: str, study: str | None = None, name: str | None = None) -> str:
    """Create a person with a role, and return their token."""
    address = f"{name or role}@{study or 'clinic'}.example"
    with transaction("test") as db:
        accounts.add_user(db, address, Role(role), PASSWORD, study_code=study)
        return accounts.create_token(db, address, "tests")


class World:
    """A study in which every route has a row to work on: one in use, and what is waiting to be decided on."""

    def __init__(self, app: Any, state: str | None = None) -> None:
        """Fill the empty database in use, or take up the one of whose world `state` was given."""
        self.app = app
        if state is None:
            self.made = 0
            self.token = token_of("admin")
            self.admin = self.calling(self.token)
            self._fill()
        else:
            self.made, self.token, self.ids, self.forms = pickle.loads(b64decode(state))
            self.admin = self.calling(self.token)

    def state(self) -> str:
        """Write what another process needs to know of the rows."""
        return b64encode(pickle.dumps((self.made, self.token, self.ids, self.forms))).decode()

    def _fill(self) -> None:
        FilledStudy(self.admin)
        ranking = self.read("/participants/P2/ranking")
        open_visit = next(v["id"] for v in self.read("/participants/P2/visits")["items"] if v["number"] == 4)
        first = {"policy_ids": [ranking["policies"][0]["policy_id"]], "seed": 1}
        # by a user who signs no plan of these tests
        assert self.calling(token_of("engineer", name="drafter")).post(f"/api/v1/visits/{open_visit}/plan", json=first).status_code == 201
        held = self.send("/participants/P2/visits", json={"number": 88, "date": f"{datetime.now(UTC):%Y-%m-%d}"})["id"]
        drafter = self.calling(token_of("engineer", name="second-drafter"))
        assert drafter.post(f"/api/v1/visits/{held}/plan", json={"random_sessions": 1, "seed": 1}).status_code == 201
        approved = self.send(f"/visits/{held}/plan/approve", json={"password": PASSWORD})["id"]
        slot = self.read(f"/visits/{held}/day")["slots"][0]["plan_item_id"]
        of_slot = {"participant": "P2", "visit": "88", "controller": "cdbs"}
        self.send("/uploads", data=of_slot, files={"file": ("day.csv", TABLE.replace(b"2,1,1", b"2,1.88,1", 1))})
        two = {"policy_ids": [p["policy_id"] for p in ranking["policies"][:2]], "order": "stated", "seed": 1}
        moved, blinded, empty = (self.send("/participants/P2/visits", json={"number": n})["id"] for n in (91, 92, 93))
        self.send(f"/visits/{moved}/plan", json=two)
        self.send(f"/visits/{blinded}/plan", json=two | {"blinded": True})
        signing = self.calling(token_of("clinician", name="signer"))
        assert signing.post(f"/api/v1/visits/{blinded}/plan/approve", json={"password": PASSWORD}).status_code == 200
        for code in ("P2", "P4"):
            self.send(f"/participants/{code}/margins/locks", json={"version": 1, "reason": "protocol", "password": PASSWORD})
        jobs = self.read("/participants/P4/jobs")["items"]
        small = next(p["id"] for p in self.read("/participants/P1/policies")["items"] if p["kind"] == "distilled")
        retired = next(p["id"] for p in self.read("/participants/P1/policies")["items"] if p["kind"] == "trained")
        elsewhere = next(p["id"] for p in self.read("/participants/P4/policies")["items"] if p["kind"] == "external")
        with transaction("admin@clinic.example") as db:
            add_found_rule(db, db.get_one(Policy, small), 1)
        visit = self.read("/participants/P4/visits")["items"][0]["id"]
        session, graspless = (s["id"] for s in self.read(f"/visits/{visit}/sessions")["items"][:2])
        derived = self.upload("d.csv", TABLE, visit="2", controller="other", more=[("g.csv", GRASPS)])["sessions"][0]["id"]
        self.send(f"/sessions/{derived}/qoc", method="put", json={"grasp_hz": 3.0, "reason": "counted by hand"})
        sampled = self.upload("s.csv", TABLE.replace(b"6,1,1", b"6,1.77,1", 1), visit="2", controller="other")["sessions"][0]["id"]
        drawn = self.upload("lfp.csv", SAMPLES, visit="2", controller="other")["sessions"][0]["id"]
        dated = self.upload("r.json", percept_report(), visit="2", controller="other")["sessions"][0]["id"]
        self.ids: Json = {
            "code": "P1",
            "visit_id": visit,
            "session_id": session,
            "upload_id": 1,
            "policy_id": small,
            "position": 1,
            "check_id": self.send(f"/policies/{small}/port-checks", **self.port_form(small))["id"],
            "study_code": "main",
            "site_code": "main",
            "snapshot_id": 1,
            "sweep_id": self.read("/participants/P1/sweeps")["items"][0]["id"],
            "job_id": next(j["id"] for j in jobs if j["status"] == "cancelled"),
        }
        self.forms: dict[tuple[str, str], Json] = {
            # members of `ids` that differ, and what is sent
            ("post", "/participants"): {"json": {"code": "Q1", "site": "main"}},
            ("patch", "/participants/{code}"): {"code": "P3", "json": {"status": "completed", "reason": "last visit held"}},
            ("get", "/sessions/{session_id}/samples"): {"session_id": sampled},
            ("get", "/sessions/{session_id}/signal"): {"session_id": drawn},
            ("post", "/studies"): {"json": {"code": "ADAPT", "name": "Adaptive"}},
            ("patch", "/studies/{study_code}"): {"json": {"name": "Main", "reason": "protocol 2"}},
            ("post", "/studies/{study_code}/sites"): {"json": {"code": "south", "name": "South"}},
            ("patch", "/studies/{study_code}/sites/{site_code}"): {"json": {"name": "Main clinic", "reason": "moved"}},
            ("put", "/studies/{study_code}/members"): {"json": {"email": "signer@clinic.example", "role": "viewer"}},
            ("post", "/studies/{study_code}/members/end"): {"json": {"email": "second-drafter@clinic.example"}},
            **{
                ("post", f"/studies/{{study_code}}{path}"): {"json": {"reason": "as agreed"}}
                for path in ("/end", "/reopen", "/sites/{site_code}/end", "/sites/{site_code}/reopen")
            },
            ("put", "/participants/{code}/settings"): {"code": "P3", "json": {"settings": {"gamma": 0.9}}},
            ("post", "/visits/{visit_id}/lock"): {"json": {"reason": "complete", "password": PASSWORD}},
            ("post", "/visits/{visit_id}/unlock"): {"json": {"reason": "rating misread"}},
            ("post", "/participants/{code}/margins/locks"): {"json": {"version": 2, "reason": "protocol", "password": PASSWORD}},
            ("post", "/participants/{code}/confirmations"): {
                "code": "P4",
                "json": {"policy_id": elsewhere, "reason": "protocol", "password": PASSWORD},
            },
            ("put", "/participants/{code}/margins"): {"json": {"margins": {"tremor_points": 5}, "reason": "she fears tremor most"}},
            ("get", "/participants/{code}/replay"): {"params": self.replayed(small)},
            ("get", "/participants/{code}/analyses/battery"): {"params": dict.fromkeys(ImplantIn.model_fields, "1")},
            ("put", "/participants/{code}/characteristics"): {
                "json": {"version": 0, "characteristics": {"hand": "left"}, "reason": "asked"}
            },
            ("post", "/visits/{visit_id}/doses"): {"visit_id": moved, "json": DOSE | {"mg": 50, "taken_at": "2026-03-02T08:00:00Z"}},
            ("post", "/doses/{dose_id}/removal"): {
                "dose_id": self.send(f"/visits/{moved}/doses", json=DOSE)["id"],
                "json": {"reason": "not taken"},
            },
            ("post", "/participants/{code}/adverse-events"): {"json": SPEECH},
            ("post", "/participants/{code}/data-queries"): {"json": self.question()},
            ("post", "/data-queries/{query_id}/entries"): {
                "query_id": self.send("/participants/P1/data-queries", json=self.question())["id"],
                "json": {"state": "answered", "text": "read again from the form", "entries": 1},
            },
            ("put", "/adverse-events/{event_id}"): {"event_id": self.event(), "json": SPEECH | {"revision": 1, "reason": "misread"}},
            ("post", "/adverse-events/{event_id}/clearance"): {"event_id": self.event(), "json": {"revision": 1, "reason": "passed"}},
            ("post", "/participants/{code}/visits"): {"json": {"number": 77}},
            ("patch", "/visits/{visit_id}"): {"json": {"note": "tired", "reason": "forgotten"}},
            ("patch", "/sessions/{session_id}"): {"json": {"excluded_reason": "cable", "reason": "said so"}},
            ("post", "/sessions/{session_id}/outcomes"): {"session_id": derived, "json": {"name": "grasp_hz", "value": 2.5}},
            ("put", "/sessions/{session_id}/conditions"): {"json": {"lower_bound": 0.2, "reason": "protocol sheet"}},
            ("put", "/sessions/{session_id}/qoc"): {"json": {"rating": 5, "reason": "misread"}},
            ("post", "/uploads"): {
                "data": {"participant": "P3", "visit": "1", "controller": "cdbs"},
                "files": {"file": ("other.csv", TABLE + b"42,1,1\n")},
            },
            ("put", "/sessions/{session_id}/markers"): {"json": {"meanings": []}},
            ("put", "/sessions/{session_id}/clock"): {
                "session_id": dated,
                "json": {"ahead_s": 60, "uncertainty_s": 5, "reason": "compared on the day"},
            },
            ("put", "/proposals/{session_id}/amplitude-source"): self.conflict(),
            ("get", "/proposals/{session_id}"): self.proposal(),
            ("patch", "/proposals/{session_id}"): self.proposal(),
            ("post", "/proposals/{session_id}/confirm"): self.proposal(controller="random"),
            ("post", "/proposals/{session_id}/split"): self.proposal(parts=[{"start_s": 0, "stop_s": 10}, {"start_s": 10, "stop_s": 30}]),
            ("post", "/proposals/{session_id}/visit"): self.proposal_of_another_day(),
            ("post", "/proposals/{session_id}/discard"): self.proposal(reason="no session"),
            ("post", "/uploaded-files/{file_id}/session"): {
                "file_id": self.upload("h.csv", GRASPS.replace(b"0.40", b"0.41"))["files"][0]["id"],
                "json": {"session_id": graspless},
            },
            ("post", "/uploaded-files/{file_id}/review"): {"file_id": self.unreadable(b"one")},
            ("post", "/uploaded-files/{file_id}/release"): {
                "file_id": self.unreadable(b"two", reviewed=True),
                "json": {"how": "as_is", "reason": "no names in it"},
            },
            ("post", "/uploaded-files/{file_id}/discard"): {"file_id": self.unreadable(b"three"), "json": {"reason": "a picture"}},
            ("get", "/uploaded-files/{file_id}/preview"): {"file_id": self.unknown_columns("a")},
            ("put", "/uploaded-files/{file_id}/mapping"): {"file_id": self.unknown_columns("b"), "json": MAPPING},
            ("post", "/column-mappings/{mapping_id}/removal"): {
                "mapping_id": self.send(f"/uploaded-files/{self.unknown_columns('c')}/mapping", "put", json=MAPPING)["mapping"]["id"],
                "json": {"reason": "the program changed"},
            },
            ("post", "/participants/{code}/policies"): {"data": {"name": "x"}, "files": {"file": ("x.onnx", constant_onnx(0.5, 10))}},
            ("post", "/policies/{policy_id}/port-checks"): self.port_form(small),
            ("post", "/policies/{policy_id}/release"): {"json": {"password": PASSWORD}},
            ("patch", "/policies/{policy_id}"): {"policy_id": retired, "json": {"retired_reason": "worn out"}},
            ("post", "/participants/{code}/jobs"): {"code": "P4", "json": {"kind": "evaluate", "preset": "quick", "methods": ["linear"]}},
            ("post", "/jobs/{job_id}/cancel"): {
                "job_id": self.send("/participants/P4/jobs", json={"kind": "evaluate", "preset": "quick", "methods": ["linear"]})["id"]
            },
            ("post", "/visits/{visit_id}/plan"): {"visit_id": visit, "json": {"policy_ids": [elsewhere]}},
            ("get", "/visits/{visit_id}/plan"): {"visit_id": open_visit},
            ("get", "/visits/{visit_id}/plan.pdf"): {"visit_id": open_visit},
            ("post", "/visits/{visit_id}/plan/approve"): {"visit_id": open_visit, "json": {"password": PASSWORD}},
            ("get", "/visits/{visit_id}/plan/sessions/{position}/bundle"): {"visit_id": held, "position": 1},
            ("get", "/visits/{visit_id}/day"): {"visit_id": held},
            ("get", "/visits/{visit_id}/day/entries"): {"visit_id": held},
            ("post", "/visits/{visit_id}/day/entries"): {
                "visit_id": held,
                "json": {"plan_id": approved, "entries": [RATED | {"plan_item_id": slot}]},
            },
            ("get", "/visits/{visit_id}/slots"): {"visit_id": held},
            ("post", "/visits/{visit_id}/slots/confirm"): {"visit_id": held, "json": {}},
            ("post", "/visits/{visit_id}/plan/moves"): {"visit_id": moved, "json": {"position": 1, "earlier": False}},
            ("post", "/visits/{visit_id}/plan/key"): {"visit_id": blinded, "json": {"reason": "end of the visit"}},
            ("post", "/visits/{visit_id}/removal"): {"visit_id": empty, "json": {"reason": "nobody came"}},
            ("post", "/participants/{code}/buffer-gate"): {"json": {"choice": "open", "reason": "agreed in the trial meeting"}},
        }

    def calling(self, token: str | None) -> TestClient:
        """Return a client with a token."""
        return TestClient(self.app, headers={"Authorization": f"Bearer {token}"} if token else {})

    def read(self, path: str) -> Any:
        """Return the answer to a GET."""
        answer = self.admin.get(f"/api/v1{path}")
        assert answer.status_code == 200, answer.text
        return answer.json()

    def send(self, path: str, method: str = "post", **form: Any) -> Any:
        """Return the answer to a call that must succeed."""
        answer = self.admin.request(method, f"/api/v1{path}", **form)
        assert answer.is_success, answer.text
        return answer.json() if "json" in answer.headers["content-type"] else answer.content

    def upload(self, name: str, content: bytes, more: list[tuple[str, bytes]] | None = None, **stated: str) -> Json:
        """Upload files of P4."""
        given = [("file", file) for file in [(name, content), *(more or [])]]
        return dict(self.send("/uploads", data={"participant": "P4", **stated}, files=given))

    def port_form(self, policy: int) -> Json:
        """Make the form of a check of a copy of a policy, and take its bundle for it."""
        answer = self.admin.get(f"/api/v1/policies/{policy}/bundle")
        assert answer.status_code == 200, answer.text
        return {"data": {"target": "TFLite"}, "files": {"file": ("answers.csv", port_answers(answer.content, 0.25))}}

    def replayed(self, policy: int) -> Json:
        """Return a session of P1 and a policy to run over it."""
        visit = self.read("/participants/P1/visits")["items"][0]["id"]
        return {"session": self.read(f"/visits/{visit}/sessions")["items"][0]["id"], "policy": policy}

    def question(self) -> Json:
        """Build a data query about a session of P1."""
        visit = self.read("/participants/P1/visits")["items"][0]["id"]
        session = self.read(f"/visits/{visit}/sessions")["items"][0]["id"]
        return {"session_id": session, "field": "rating", "text": "7 in the file, 8 on the form?"}

    def event(self) -> int:
        """Add a serious adverse event of its own for one route."""
        return int(self.send("/participants/P1/adverse-events", json=SPEECH)["id"])

    def proposal(self, **change: Any) -> Json:
        """Add a proposal of its own for one route."""
        self.made += 1
        body = self.upload(f"p{self.made}.csv", TABLE.replace(b"2,1,1", b"2,1.%d,1" % self.made, 1), visit="3")
        (proposal,) = body["proposals"]
        return {"session_id": proposal["session"]["id"], "json": {"version": proposal["version"]} | change}

    def conflict(self) -> Json:
        """Make a proposal whose two columns of the amplitude contradict each other, and the choice of one."""
        rows = "".join(f"{2 * k},1,2,{0.5 if k == 5 else 1}\n" for k in range(1, 21))
        body = self.upload("conflict.csv", f"t_s,beta,amplitude_ma,amplitude_fraction\n{rows}".encode(), visit="3")
        (proposal,) = body["proposals"]
        choice = {"source": "amplitude_ma", "reason": "seen on the tablet", "version": proposal["version"]}
        return {"session_id": proposal["session"]["id"], "json": choice}

    def proposal_of_another_day(self) -> Json:
        """Add a proposal on whose day there is no visit, for the route that adds one."""
        body = self.upload("day.csv", TABLE.replace(b"2,1,1", b"2,1.99,1", 1), visit="", started_at="2025-07-01T09:00:00Z")
        (proposal,) = body["proposals"]
        return {"session_id": proposal["session"]["id"], "json": {"version": proposal["version"]}}

    def unreadable(self, content: bytes, reviewed: bool = False) -> int:
        """Add a file in quarantine of its own for one route."""
        body = self.upload(
            "t.csv", TABLE.replace(b"4,1,1", b"4,%d,1" % len(content), 1), more=[("noise.bin", b"\x00\x01" + content)], visit="3"
        )
        number = next(int(f["id"]) for f in body["files"] if f["quarantined"])
        if reviewed:
            self.send(f"/uploaded-files/{number}/review")
        return number

    def unknown_columns(self, name: str) -> int:
        """Add a table that waits for a column mapping, of its own for one route."""
        table = f"{name};signal;current\n" + "".join(f"{2 * k};{k / 7:.2f};1.5\n" for k in range(1, 12))
        body = self.upload("t.csv", TABLE.replace(b"4,1,1", b"4,7.%d,1" % ord(name), 1), more=[("u.csv", table.encode())], visit="3")
        return next(int(f["id"]) for f in body["files"] if f["waits_for_mapping"])

    def ids_of(self, method: str, path: str) -> Json:
        """Return the path members of a route by name: rows that the route can work on."""
        form = self.forms.get((method, path.removeprefix("/api/v1")), {})
        return self.ids | {name: value for name, value in form.items() if name in self.ids or name in OWN}

    def call(self, client: TestClient, method: str, path: str) -> int:
        """Return the status of a call that is right in everything but, perhaps, who makes it."""
        form = dict(self.forms.get((method, path.removeprefix("/api/v1")), {}))
        ids = self.ids_of(method, path)
        form = {name: value for name, value in form.items() if name not in ids}
        if method == "get":
            form.pop("json", None)
        with client.stream(method, path.format(**ids), **form) as answer:
            return int(answer.status_code)
