"""An address for every page of the service, on the study of `tests.app.every_route`."""

from __future__ import annotations

from typing import Any

from fastapi.routing import iter_route_contexts

from app.platform.database import transaction
from app.tables.jobs import Job, JobEvent
from tests.app.every_route import World

ELSEWHERE = {
    "/sign-on": "leads to the hospital's sign-on, which this study has none of",
    "/sign-on/confirm": "the same",
    "/sign-on/return": "the same",
    "/sign-on/end": "the same",
    "/visit-day/files/{path:path}": "a script or a style of the day page, by its name",
}
"""Addresses without /api that have no page, or none without what other tests bring along."""


def routes(app: Any) -> list[str]:
    """List every address that a browser may open, less the REST interface's and what operates the service."""
    found = {c.path for c in iter_route_contexts(app.routes) if c.path and "GET" in (getattr(c, "methods", None) or ())}
    return sorted(p for p in found if not p.startswith(("/api/", "/healthz", "/readyz", "/metrics")))


def addresses(world: World) -> dict[str, str]:
    """Return, by route, the address of a page that has something to show, for everything that a browser may open."""
    own: dict[str, dict[str, Any]] = {
        "/participants/{code}/ranking": {"code": "P2"},
        "/participants/{code}/proposals": {"code": "P4"},
        "/participants/{code}/quarantine": {"code": "P4"},
        "/participants/{code}/jobs": {"code": "P4"},
        "/participants/{code}/analyses/visits/{key}": {"key": "distilled"},
        "/participants/{code}/analyses/models/{key}": {"key": "distilled"},
        "/proposals/{session_id}": world.ids_of("get", "/api/v1/proposals/{session_id}"),
        "/sessions/{session_id}/signal": world.ids_of("get", "/api/v1/sessions/{session_id}/signal"),
        "/sessions/{session_id}/signal.json": world.ids_of("get", "/api/v1/sessions/{session_id}/signal"),
        "/uploaded-files/{file_id}/mapping": world.ids_of("get", "/api/v1/uploaded-files/{file_id}/preview"),
        "/visits/{visit_id}/plan": world.ids_of("get", "/api/v1/visits/{visit_id}/plan"),
        "/visits/{visit_id}/slots": world.ids_of("get", "/api/v1/visits/{visit_id}/slots"),
        "/visits/{visit_id}/bundles": world.ids_of("get", "/api/v1/visits/{visit_id}/day"),
        "/visit-day/{visit_id}": world.ids_of("get", "/api/v1/visits/{visit_id}/day"),
    }
    students = [p["id"] for p in world.read("/participants/P1/policies")["items"] if p["kind"] == "distilled"]
    queries = {"/search": "?q=rl", "/participants/{code}/compare": "?session=1" + "".join(f"&policy={i}" for i in students[:2])}
    paths = [p for p in routes(world.app) if p not in ELSEWHERE]
    return {p: p.format(**(world.ids | own.get(p, {}))) + queries.get(p, "") for p in paths}


PARTS = {
    "train": ("plan", "train/", "baselines", "store-policies"),
    "evaluate": ("plan", "fit/", "store-models", "choose", "estimate/", "rank"),
}
"""Steps of a pipeline, by their keys' beginnings, of which a job of one kind consists."""


def ended_jobs(world: World) -> dict[str, str]:
    """Return, by kind, the page of a succeeded job with steps, learning curves and a log: a pipeline, and what it is made of.

    `failed` is one whose step raised what only engineers can read.
    """
    found = next(j for j in world.read("/participants/P1/jobs")["items"] if j["kind"] == "pipeline" and j["status"] == "succeeded")
    pages = {"pipeline": f"/jobs/{found['id']}"}
    with transaction("test") as db:
        whole = db.get_one(Job, found["id"])
        events = db.query(JobEvent).filter_by(job_id=whole.id).order_by(JobEvent.id).all()
        assert {"points"} <= {e.kind for e in events}
        for number, (kind, keys) in enumerate(PARTS.items()):
            steps = [s for s in whole.steps if s.key.startswith(keys)]
            assert len(steps) >= 4, kind
            job = Job(id=f"4f00aaaa-0000-4000-8000-00000000000{number}", kind=kind, steps=[_copy(s, ("id", "job_id")) for s in steps])
            for name in ("participant_id", "status", "progress", "message", "code_version", "created_by", "started_at", "finished_at"):
                setattr(job, name, getattr(whole, name))
            job.params, job.result = {}, {"snapshot_id": 1}
            db.add(job)
            db.flush()
            of_it = [e for e in events if e.step_key and e.step_key.startswith(keys)]
            db.add_all([_copy(e, ("id", "job_id"), job_id=job.id) for e in of_it])
            db.add(JobEvent(job_id=job.id, step_key=steps[1].key, kind="log", data={"text": "member 1 of the DLSM ran to its last update"}))
            pages[kind] = f"/jobs/{job.id}"
        first = db.get_one(Job, pages["evaluate"].removeprefix("/jobs/"))
        raised = "ValueError: the DLSM needs at least 4 sessions in the buffer"
        failed = _copy(first, ("id",), id="4f00aaaa-0000-4000-8000-000000000009", status="failed", result=None)
        failed.steps = [_copy(s, ("id", "job_id")) for s in first.steps]
        failed.steps[0].status, failed.steps[0].message = "failed", raised
        failed.error = failed.message = f"Step {failed.steps[0].key} failed: {raised}"
        db.add(failed)
        pages["failed"] = f"/jobs/{failed.id}"
    return pages


def _copy(row: Any, but: tuple[str, ...], **more: Any) -> Any:
    """Copy a row of a table with its values."""
    return type(row)(**{c.key: getattr(row, c.key) for c in type(row).__table__.columns if c.key not in but} | more)
