"""The web service: routers of every phase, static files, health and metrics."""

from __future__ import annotations

import gc
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from functools import partial
from importlib import import_module
from typing import Any

import plotly
import structlog
from fastapi import APIRouter, Depends, FastAPI, Request, Response
from fastapi.openapi.utils import get_openapi
from fastapi.responses import JSONResponse
from fastapi.staticfiles import StaticFiles
from prometheus_client import CONTENT_TYPE_LATEST, generate_latest
from starlette.concurrency import run_in_threadpool

from app import __version__
from app.accounts.deps import METRICS, CurrentCaller, judge, reader_of_figures
from app.analysis.standing import outlook, standing_sentences
from app.planning.plans.suggested import suggested_visit
from app.planning.slots.web import facts as slots_of_visit
from app.platform import logs
from app.platform.bucket import prune_copies_beside
from app.platform.database import Db, check_connection
from app.platform.errors import DatabaseAway
from app.platform.files import remove_abandoned
from app.platform.upkeep.migrate import newest_revision, revision
from app.platform.web import middleware as web
from app.platform.web import templates
from app.platform.web.compression import CompressedFiles
from app.platform.web.schemas import problems
from app.platform.web.templates import STATIC
from app.study.deps import ResultsViewed

log = structlog.get_logger()

DESCRIPTION = "/api/v1/openapi.json"

API_ROUTERS = (
    "app.accounts.studies_web:api",
    "app.study.routes.api:router",
    "app.study.routes.participation:api",
    "app.study.margins_web:api",
    "app.study.routes.characteristics:api",
    "app.study.routes.doses:api",
    "app.study.adverse_events_web:api",
    "app.study.data_queries_web:api",
    "app.study.recordings.web:api",
    "app.ingest.uploads.api:router",
    "app.ingest.proposals.api:router",
    "app.ingest.proposals.meanings_web:api",
    "app.ingest.quarantine.api:router",
    "app.ingest.mappings.api:router",
    "app.learning.policies_web:api",
    "app.learning.snapshots_web:api",
    "app.learning.gate_web:api",
    "app.learning.sweeps_web:api",
    "app.evaluation.ranking.web:api",
    "app.evaluation.policies.replay_web:api",
    "app.pipeline.api:router",
    "app.planning.plans.api:router",
    "app.planning.bundles.api:of_plans",
    "app.planning.bundles.api:router",
    "app.planning.bundles.release_web:api",
    "app.planning.visit_day.api:router",
    "app.planning.slots.web:api",
    "app.analysis.primary_web:api",
    "app.analysis.metrics_web:api",
    "app.analysis.pooled_web:api",
    "app.analysis.evaluations_web:api",
    "app.analysis.energy_web:api",
    "app.analysis.biomarker_web:api",
    "app.analysis.calibration_web:api",
    "app.overview.signals_web:samples_api",
    "app.overview.signals_web:api",
    "app.study.routes.participation:closing_api",
)
PAGE_ROUTERS = (
    "app.accounts.pages:router",
    "app.accounts.sign_on_web:pages",
    "app.accounts.studies_web:pages",
    "app.study.routes.participation:pages",
    "app.study.settings_web:pages",
    "app.study.margins_web:pages",
    "app.study.routes.characteristics:pages",
    "app.study.routes.doses:pages",
    "app.study.adverse_events_web:pages",
    "app.study.data_queries_web:pages",
    "app.study.recordings.web:pages",
    "app.study.routes.visits:pages",
    "app.study.sessions.pages:router",
    "app.ingest.uploads.pages:router",
    "app.ingest.proposals.pages:router",
    "app.ingest.proposals.meanings_web:pages",
    "app.ingest.quarantine.pages:router",
    "app.ingest.mappings.pages:router",
    "app.learning.policies_web:pages",
    "app.learning.gate_web:pages",
    "app.learning.sweeps_web:pages",
    "app.evaluation.ranking.web:pages",
    "app.evaluation.policies.replay_web:pages",
    "app.evaluation.policies.web:pages",
    "app.pipeline.pages:router",
    "app.pipeline.next_generation_web:pages",
    "app.planning.plans.pages:router",
    "app.planning.bundles.pages:router",
    "app.planning.visit_day.pages:router",
    "app.planning.slots.web:pages",
    "app.analysis.primary_web:pages",
    "app.analysis.metrics_web:pages",
    "app.analysis.pooled_web:pages",
    "app.analysis.evaluations_web:pages",
    "app.analysis.energy_web:pages",
    "app.analysis.biomarker_web:pages",
    "app.analysis.calibration_web:pages",
    "app.overview.overview_web:pages",
    "app.overview.trail_web:pages",
    "app.overview.reference_web:pages",
    "app.overview.signals_web:pages",
)


class _Static(StaticFiles):
    """Static files whose URLs carry a hash: browsers keep them for ever."""

    def file_response(self, *args: Any, **kwargs: Any) -> Response:
        response = super().file_response(*args, **kwargs)
        response.headers["Cache-Control"] = "public, max-age=31536000, immutable"
        return response


def router_of(name: str) -> APIRouter:
    """Load a router by its name: `module:router`."""
    module, _, router = name.partition(":")
    found: APIRouter = getattr(import_module(module), router)
    return found


def _watched(router: str) -> list[Any]:
    """Return the dependencies that all routes of a router share: analyses record who looked at results."""
    return [ResultsViewed] if router.startswith("app.analysis.") else []


def create_app() -> FastAPI:
    """Build the service. The database is reached at the first request, not here."""
    gc.disable()  # what is loaded now stays: to look through it meanwhile takes a third of the time
    try:
        return _built()
    finally:
        gc.enable()


def _built() -> FastAPI:
    logs.configure_own()
    app = FastAPI(
        title="betaloop", version=__version__, openapi_url=None, docs_url=None, redoc_url=None, lifespan=_lifespan
    )  # fmt: skip
    web.install(app, judge)
    api = APIRouter(prefix="/api/v1")
    for name in API_ROUTERS:
        api.include_router(router_of(name), dependencies=_watched(name))
    app.include_router(api)
    for name in PAGE_ROUTERS:
        app.include_router(router_of(name), include_in_schema=False, dependencies=_watched(name))
    app.include_router(_service_routes())
    app.mount("/static/plotly", CompressedFiles(packages=[(plotly.__name__, "package_data")]))
    app.mount("/static", _Static(directory=STATIC))
    app.state.description = DESCRIPTION
    templates.provide(templates.Part.OUTLOOK, outlook)
    templates.provide(templates.Part.SUGGESTED_VISIT, suggested_visit)
    templates.provide(templates.Part.STANDINGS, standing_sentences)
    templates.provide(templates.Part.TESTED_STANDINGS, partial(standing_sentences, every=False))
    templates.provide(templates.Part.SLOTS_OF_VISIT, slots_of_visit)
    app.openapi = lambda: _openapi(app)  # type: ignore[method-assign]
    return app


SEARCHED_AFTER = (10_000, 20, 20)
"""New objects after which the youngest are searched for garbage, searches after which the older are, and all of them. A page makes some 7
000. Results that the service caches are among the oldest, and to search them takes 0.1 to 0.2 s. By the interpreter's default (700, 10, 10)
every thirteenth request waited for that. Nearly all garbage goes without any search, when its last reference does.
"""


def leave_to_itself() -> None:
    """Take what the process has loaded by now out of garbage collection, for it stays, and search what it keeps later on seldom."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(*SEARCHED_AFTER)


@asynccontextmanager
async def _lifespan(_: FastAPI) -> AsyncIterator[None]:
    """Remove, at the start of the service, what killed processes left of incoming files, so that it cannot keep a full disk full."""
    leave_to_itself()
    removed = await run_in_threadpool(remove_abandoned)
    prune_copies_beside()
    if removed:
        log.info("abandoned incoming files removed", files=removed)
    yield


def _service_routes() -> APIRouter:
    router = APIRouter()

    @router.get("/healthz", tags=["service"])
    def healthz(db: Db) -> dict[str, str]:
        """Return whether the service and its database answer; no token needed."""
        check_connection(db)
        return {"status": "ok", "version": __version__}

    @router.get("/readyz", tags=["service"], responses=problems(503))
    def readyz(db: Db) -> dict[str, str]:
        """Return whether requests can be served: the database answers and has the schema of this version; no token needed."""
        if (has := revision(db)) != (needs := newest_revision()):
            raise DatabaseAway(f"The database has schema {has or 'none'}; this version needs {needs}.", "Run `betaloop migrate`.")
        return {"status": "ready", "schema": has}

    @router.get(METRICS, include_in_schema=False, dependencies=[Depends(reader_of_figures)])
    def metrics() -> Response:
        """Return Prometheus metrics."""
        return Response(generate_latest(), media_type=CONTENT_TYPE_LATEST)

    @router.get(DESCRIPTION, include_in_schema=False)
    def description(request: Request, _: CurrentCaller) -> JSONResponse:
        """Return the OpenAPI document (sign-in or token required)."""
        return JSONResponse(request.app.openapi())

    return router


_PROBLEM = {"application/problem+json": {"schema": {"$ref": "#/components/schemas/Problem"}}}
_BEFORE_ROUTES = {
    400: "The body cannot be read: it is no JSON in UTF-8 (nested less than a thousand deep, numbers of ordinary length), no whole form,"
    " or ended early.",
    413: "The body is larger than this kind of request may have.",
    429: "Too many tries, or too much was sent from here lately; `Retry-After` says when another try makes sense.",
    503: "The database does not answer for the moment, or this was given up for another request; try again later.",
    507: "No room is left on the disk; what was stored before is safe.",
}
"""What operations may answer before, or whatever, their routes do."""


def _openapi(app: FastAPI) -> dict[str, Any]:
    """Build the OpenAPI document; problems are application/problem+json, and FastAPI's own validation schema is removed."""
    if app.openapi_schema:
        return app.openapi_schema
    document = get_openapi(title=app.title, version=app.version, routes=app.routes, description="REST interface of a betaloop study.")
    for path in document["paths"].values():
        for method, operation in path.items():
            responses = operation["responses"]
            for status in _answered_before(method, operation):
                responses.setdefault(str(status), {"description": _BEFORE_ROUTES[status]})
            for status, response in responses.items():
                if int(status) >= 400:
                    response["content"] = _PROBLEM
    for unused in ("HTTPValidationError", "ValidationError"):
        document.get("components", {}).get("schemas", {}).pop(unused, None)
    app.openapi_schema = document
    return document


def _answered_before(method: str, operation: dict[str, Any]) -> set[int]:
    """Select those of these responses that an operation may give."""
    found = {503}
    if "security" in operation:  # who calls is looked up, and their token's last use is written down, also for reads
        found |= {507}
    if method != "get":
        found |= {413, 429}
    if "requestBody" in operation:
        found |= {400}
    return found
