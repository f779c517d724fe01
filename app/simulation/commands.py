"""The commands `betaloop study simulate` and `betaloop study demo-files`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from app.platform.database import transaction
from app.platform.terminal import ACTOR, AsJson, show


def simulate(
    visits: Annotated[int | None, typer.Option(min=2, max=60, help="Visits of each participant; the preset's by default.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of everything random in the study.")] = 0,
    participants: Annotated[str, typer.Option(help="Codes of synthetic participants, with commas between them.")] = "P1,P2,P3,P4",
    preset: Annotated[str, typer.Option(help="'quick': for a first look; 'full': about the paper's trial time.")] = "quick",
    as_json: AsJson = False,
) -> None:
    """Run the whole trial loop on synthetic participants, who are not fitted to patients; started again, it goes on where it was."""
    from app.platform.upkeep.migrate import migrate as bring_up_to_date
    from app.simulation.design import design
    from app.simulation.run import as_dict, as_table
    from app.simulation.run import simulate as run_study

    wanted = design(participants.split(","), visits, seed, preset)
    bring_up_to_date()
    caller = run_study(wanted)
    with transaction(ACTOR) as db:
        table = as_table(db, wanted.participants, caller)
        result = as_dict(db, wanted.participants, caller)
    if as_json:
        show(result, True, "")
    else:
        Console().print(table)


def demo_files(
    folder: Annotated[Path, typer.Argument(help="Where the files go: one for each participant.")],
    participants: Annotated[str, typer.Option(help="Codes with commas between them.")] = "P2,P3,P4",
    seed: Annotated[int | None, typer.Option(min=0, help="Of what is learned; the demo's own by default.")] = None,
) -> None:
    """Learn the policies of the demo's participants on their earlier visits, and hold the sessions that tested them; takes minutes."""
    from app.simulation.demo.making import make

    out = Console(stderr=True)
    for path in make(folder, tuple(participants.split(",")), lambda line: out.print(line, highlight=False), seed):
        out.print(f"{path}: {path.stat().st_size / 1000:.0f} kB", highlight=False)


def register(study: typer.Typer) -> None:
    """Add the commands."""
    study.command("simulate", epilog="Example: betaloop study simulate --participants P1 --preset quick")(simulate)
    study.command("demo-files", epilog="Example: betaloop study demo-files app/simulation/demo/files --participants P3")(demo_files)
