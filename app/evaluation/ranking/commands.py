"""The command `betaloop rank`."""

from __future__ import annotations

from typing import Any

import typer
from rich.console import Console
from rich.table import Table

from app.accounts.permissions import SYSTEM
from app.platform.database import transaction
from app.platform.terminal import ACTOR, AsJson, Code, show


def rank(code: Code, as_json: AsJson = False) -> None:
    """Print the ranked policies of a participant."""
    from app.evaluation.ranking.service import current_ranking
    from app.study import repository as study

    with transaction(ACTOR) as db:
        body = current_ranking(db, study.participant_by_code(db, code, SYSTEM), SYSTEM).model_dump(mode="json")
    if as_json:
        show(body, True, "")
        return
    console = Console()
    title = f"{code}: estimated return over {body['horizon_steps']} steps (method {body['default_method']})"
    table = Table(title=title, caption="STALE: " + body["stale_reason"] if body["stale"] else None)
    for heading in ("rank", "policy", "verdict", "return", "interval", "supported"):
        table.add_column(heading)
    for row in body["policies"]:
        best = row["estimates"].get(body["default_method"])
        shown = ("—", "—", "—") if best is None else _estimate_cells(best)
        table.add_row(str(row["rank"] or "—"), row["name"], (row["decision"] or "—").replace("_", " "), *shown)
    console.print(table)
    for sentence in body["notes"]:
        console.print(sentence, markup=False, highlight=False)


def register(app: typer.Typer) -> None:
    """Add the command."""
    app.command(epilog="Example: betaloop rank P1")(rank)


def _estimate_cells(estimate: dict[str, Any]) -> tuple[str, str, str]:
    interval = f"{estimate['low']:.2f} … {estimate['high']:.2f}"
    return f"{estimate['value']:.2f}", interval, "yes" if estimate.get("supported", True) else "no"
