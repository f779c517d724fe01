"""Names of the modules that define tables; the migration environment and the test database load them all through here.

A list of names and not of imports: the platform is below the phases and may not import them.
"""

from __future__ import annotations

from importlib import import_module

TABLE_MODULES = (
    "app.platform.audit.trail",
    "app.platform.audit.chain",
    "app.platform.files",
    "app.platform.signatures.models",
    "app.platform.jobs.models",
    "app.accounts.models",
    "app.study.models",
    "app.study.characteristics.models",
    "app.study.doses.models",
    "app.study.margins.models",
    "app.study.adverse_events.models",
    "app.study.data_queries.models",
    "app.study.outcomes.models",
    "app.study.sessions.models",
    "app.ingest.models",
    "app.learning.models",
    "app.evaluation.models",
    "app.planning.plans.models",
    "app.planning.bundles.models",
    "app.planning.visit_day.models",
)


def load_tables() -> None:
    """Import every module with tables, so that the metadata are complete and foreign keys resolve."""
    for name in TABLE_MODULES:
        import_module(name)
