"""For the form of every page: a call that is right in everything but, perhaps, who makes it, on the study of `tests.app.every_route`."""

from __future__ import annotations

from typing import Any

from fastapi.routing import iter_route_contexts
from fastapi.testclient import TestClient

from app.accounts import repository
from app.accounts import service as accounts
from app.accounts.deps import COOKIE
from app.learning.policies import constant_onnx
from app.platform.database import new_session, transaction
from app.tables.accounts import Role
from tests.app.every_route import DOSE, MAPPING, PASSWORD, RATED, SPEECH, TABLE, World

Call = dict[str, Any]
LIMITS = {"min_ma": "0", "max_ma": "3", "ramp_ma_per_s": "1.5"}
NEW = "another good password"


def posts(app: Any) -> set[tuple[str, str]]:
    """List (method, path) of every form, all methods that change something."""
    found = {(m.lower(), c.path) for c in iter_route_contexts(app.routes) if c.path for m in getattr(c, "methods", None) or ()}
    return {(m, p) for m, p in found if m not in ("get", "head", "options") and not p.startswith("/api/")}


def browser(app: Any, role: str, study: str | None = None, site: int | None = None) -> TestClient:
    """Create a person with a role in a study or one site, whose browser is signed in; redirects are seen, not followed."""
    with transaction("test") as db:
        address = f"{role}-browser@{study or 'clinic'}.example"
        user = accounts.add_user(db, address, Role(role), PASSWORD, study_code=study)
        user.memberships[0].site_id = site
        token = accounts.open_session(db, user)
    headers = {"Accept": "text/html", "Sec-Fetch-Site": "same-origin"}
    return TestClient(app, headers=headers, cookies={COOKIE: token}, follow_redirects=False)


def calls(world: World) -> dict[str, Call]:
    """Return, by path, what is sent (`data`, `files`), and members of the path that differ from the world's own."""
    with new_session() as db:
        people = {name: user.id for name in ("signer", "drafter") if (user := repository.user_by_email(db, f"{name}@clinic.example"))}
    return _of_people(people) | _of_participants(world) | _of_visits(world) | _of_files(world) | _of_learning(world) | _of_plans(world)


def of_api(world: World, method: str, path: str) -> Call:
    """Return the members of the path of the route that does the same."""
    return dict(world.ids_of(method, f"/api/v1{path}"))


def _of_people(people: dict[str, int]) -> dict[str, Call]:
    person = {"email": "new@clinic.example", "name": "New", "role": "viewer", "study": "main", "password": NEW}
    return {
        "/studies": {"data": {"code": "ADAPT", "name": "Adaptive"}},
        "/studies/{study_code}": {"data": {"name": "Main", "reason": "protocol 2"}},
        "/studies/{study_code}/sites/{site_code}": {"data": {"name": "Main clinic", "reason": "moved"}},
        **{
            f"/studies/{{study_code}}{path}": {"data": {"reason": "as agreed"}}
            for path in ("/end", "/reopen", "/sites/{site_code}/end", "/sites/{site_code}/reopen")
        },
        "/studies/{study_code}/sites": {"data": {"code": "south", "name": "South"}},
        "/studies/{study_code}/members": {"data": {"email": "signer@clinic.example", "role": "viewer", "site": ""}},
        "/studies/{study_code}/members/end": {"data": {"email": "second-drafter@clinic.example", "site": ""}},
        "/accounts": {"data": person},
        "/accounts/{user_id}/password": {"user_id": people["signer"], "data": {"password": NEW}},
        "/accounts/{user_id}/active": {"user_id": people["drafter"], "data": {"active": "no"}},
    }


def _of_participants(world: World) -> dict[str, Call]:
    speech = SPEECH | {"serious": "yes"}
    event = {method: of_api(world, "put" if method == "correction" else "post", path) for method, path in (
        ("correction", "/adverse-events/{event_id}"), ("clearance", "/adverse-events/{event_id}/clearance"))}  # fmt: skip
    ranked = world.read("/participants/P2/ranking")["policies"][0]["policy_id"]
    version = world.read("/participants/P3")["settings"]["version"]
    return {
        "/participants": {"data": {"code": "Q2", "site": "main"}},
        "/participants/{code}/settings": {"code": "P3", "data": {"version": str(version), "gamma": "0.9", "reason": "agreed"}},
        "/participants/{code}/margins": {"data": {"version": "1", "tremor_points": "5", "reason": "she fears tremor most"}},
        "/participants/{code}/margins/lock": {"data": {"version": "2", "lock_reason": "protocol", "password": PASSWORD}},
        "/participants/{code}/margins/confirmations": {
            "code": "P2",
            "data": {"policy_id": str(ranked), "confirmation_reason": "protocol", "password": PASSWORD},
        },
        "/participants/{code}/characteristics": {"data": {"version": "0", "hand": "left", "reason": "asked"}},
        "/participants/{code}/adverse-events": {"data": speech},
        "/adverse-events/{event_id}/correction": event["correction"] | {"data": speech | {"revision": "1", "reason": "misread"}},
        "/adverse-events/{event_id}/clearance": event["clearance"] | {"data": {"revision": "1", "reason": "passed"}},
        "/participants/{code}/data-queries": {"data": world.question()},
        "/data-queries/{query_id}/entries": of_api(world, "post", "/data-queries/{query_id}/entries")
        | {"data": {"state": "answered", "text": "read again from the form", "entries": "1"}},
    }


def _of_visits(world: World) -> dict[str, Call]:
    locked = world.read("/participants/P2/visits")["items"][0]["id"]
    revision = world.read(f"/sessions/{world.ids['session_id']}/conditions")["revision"]
    return {
        "/participants/{code}/visits": {"data": {"number": "78", "date": "2026-11-01", "note": ""}},
        "/visits/{visit_id}": {"data": {"note": "tired", "reason": "forgotten"}},
        "/visits/{visit_id}/lock": {"visit_id": locked, "data": {"lock_reason": "complete", "password": PASSWORD}},
        "/visits/{visit_id}/doses": of_api(world, "post", "/visits/{visit_id}/doses")
        | {"data": DOSE | {"mg": "50", "taken_at": "2026-03-02T08:00:00Z"}},
        "/doses/{dose_id}/removal": of_api(world, "post", "/doses/{dose_id}/removal") | {"data": {"reason": "not taken"}},
        "/sessions/{session_id}/qoc": {"data": {"rating": "5", "reason": "misread"}},
        "/sessions/{session_id}/clock": of_api(world, "put", "/sessions/{session_id}/clock")
        | {"data": {"ahead_s": "60", "uncertainty_s": "5", "clock_reason": "compared on the day"}},
        "/sessions/{session_id}/markers": {"data": {"reason": "asked at the lab"}},
        "/sessions/{session_id}/correction": {"data": {"hemisphere": "left", "reason": "protocol sheet"}},
        "/sessions/{session_id}/conditions": {
            "data": {"revision": str(revision), "lower_bound": "0.2", "conditions_reason": "protocol sheet"}
        },
        "/sessions/{session_id}/derived": of_api(world, "post", "/sessions/{session_id}/outcomes")
        | {"data": {"name": "grasp_hz", "value": "2.5"}},
        "/sessions/{session_id}/exclusion": {"data": {"excluded_reason": "cable"}},
    }


def _of_files(world: World) -> dict[str, Call]:
    proposal = world.forms["post", "/proposals/{session_id}/discard"]
    number, version = proposal["session_id"], proposal["json"]["version"]
    mapping = {name: value for name, value in MAPPING.items() if name != "columns"} | {"name": "three columns", "unit_lines": "0"}
    for column in MAPPING["columns"]:  # type: ignore[attr-defined]
        mapping |= {f"{part}_{column['number']}": value for part, value in column.items() if part != "number"}
    file = "/uploaded-files/{file_id}"
    grasps = world.forms["post", f"{file}/session"]["json"]
    return {
        "/participants/{code}/upload": {
            "code": "P3", "data": {"visit": "1", "controller": "cdbs"}, "files": {"file": ("p.csv", TABLE + b"42,1,1\n44,1,1\n")}
        },
        "/participants/{code}/proposals": {
            "code": "P4", "data": {"do": f"discard:{number}", f"version-{number}": str(version), f"reason-{number}": "no session"}
        },
        f"{file}/session": of_api(world, "post", f"{file}/session") | {"data": grasps},
        f"{file}/decision": of_api(world, "post", f"{file}/discard") | {"data": {"do": "discard", "reason": "a picture"}},
        f"{file}/mapping": of_api(world, "put", f"{file}/mapping") | {"data": mapping},
        "/column-mappings/{mapping_id}/remove": of_api(world, "post", "/column-mappings/{mapping_id}/removal")
        | {"data": {"reason": "the program changed"}},
    }  # fmt: skip


def _of_learning(world: World) -> dict[str, Call]:
    policy = "/participants/{code}/policies/{policy_id}"
    return {
        "/participants/{code}/policies": {"data": {"name": "y"}, "files": {"file": ("y.onnx", constant_onnx(0.6, 10))}},
        f"{policy}/bundle": {"data": LIMITS},
        f"{policy}/threshold-rule": {"data": {"min_ma": "0", "preset": "quick", "device": "percept_pc"}},
        f"{policy}/ports": of_api(world, "post", "/policies/{policy_id}/port-checks")
        | {name: world.forms["post", "/policies/{policy_id}/port-checks"][name] for name in ("data", "files")},
        f"{policy}/release": {"data": LIMITS | {"password": PASSWORD}},
        f"{policy}/retire": of_api(world, "patch", "/policies/{policy_id}") | {"data": {"reason": "worn out"}},
        "/participants/{code}/buffer-gate": {"data": {"choice": "open", "reason": "agreed in the trial meeting"}},
        "/participants/{code}/jobs": {"code": "P4", "data": {"kind": "evaluate", "preset": "quick", "methods": "linear", "again": "on"}},
        "/participants/{code}/next-generation": {"code": "P2", "data": {}},
        "/jobs/{job_id}/cancel": of_api(world, "post", "/jobs/{job_id}/cancel"),
        "/jobs/{job_id}/retry": of_api(world, "post", "/jobs/{job_id}/retry"),
    }


def _of_plans(world: World) -> dict[str, Call]:
    plan = "/visits/{visit_id}/plan"
    draft = of_api(world, "post", f"{plan}/approve")
    number = world.read(f"/visits/{draft['visit_id']}/plan")["id"]
    tested = world.read("/participants/P2/ranking")["policies"][0]["policy_id"]
    day = world.forms["post", "/visits/{visit_id}/day/entries"]
    slot = day["json"]["entries"][0]["plan_item_id"]
    rated = {"kind": "rating", "value": "7", "uuid": RATED["uuid"], "attempt": "1", "plan_item_id": slot, "plan_id": day["json"]["plan_id"]}
    return {
        f"{plan}/approve": draft | {"data": {"plan_id": str(number), "password": PASSWORD}},
        plan: {"data": {"policy_ids": str(world.forms["post", plan]["json"]["policy_ids"][0])}},
        "/participants/{code}/plan/draft": {
            "code": "P2", "data": {"policy_ids": str(tested), "visit_number": "94", "visit_date": "2199-01-01"}
        },
        f"{plan}/move": of_api(world, "post", f"{plan}/moves") | {"data": {"position": "1", "earlier": "no"}},
        f"{plan}/key": of_api(world, "post", f"{plan}/key") | {"data": {"reason": "end of the visit"}},
        "/visits/{visit_id}/remove": of_api(world, "post", "/visits/{visit_id}/removal") | {"data": {"reason": "nobody came"}},
        "/visit-day/{visit_id}": {"visit_id": day["visit_id"], "data": rated},
        "/visits/{visit_id}/slots/confirm": of_api(world, "post", "/visits/{visit_id}/slots/confirm"),
        "/participants/{code}/status": {"code": "P3", "data": {"status": "completed", "status_reason": "last visit held"}},
    }  # fmt: skip
