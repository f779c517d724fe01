"""Commands of the audit trail: `betaloop audit verify`, `betaloop audit accept` and `betaloop audit seal`."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated

import typer

from app.platform.audit.breaks import BreakKind, accept, sentence
from app.platform.audit.chain import Verified, seal, verify
from app.platform.database import new_session, transaction
from app.platform.terminal import ACTOR, AsJson, Why, bad_call, print_line, show

app = typer.Typer(no_args_is_help=True, help="The audit trail.")


@app.command("verify", epilog="Example: betaloop audit verify")
def verify_(as_json: AsJson = False) -> None:
    """Compute the hash chain of the audit trail again and hold its seals against it; exit code 1 where it is broken."""
    with new_session() as db:
        found = verify(db)
    show(asdict(found) | {"whole": found.whole}, as_json, "\n".join(sentences(found)))
    if not found.whole:
        raise typer.Exit(1)


@app.command("accept", epilog="Example: betaloop audit accept 4711 --reason 'the clock was a week ahead until it was set by NTP'")
def accept_(row: Annotated[int, typer.Argument(help="Number of the row of the trail, as `audit verify` names it.")], why: Why) -> None:
    """Say that a false time was looked into: `audit verify` lists it with this reason, and calls it a break no more.

    Nothing else that `audit verify` names can be accepted.
    """
    with transaction(ACTOR) as db:
        if not any(b.kind is BreakKind.BACKDATED and b.event_id == row for b in verify(db).breaks):
            raise bad_call(f"`betaloop audit verify` names no false time of row {row}; nothing else is accepted.")
        accept(db, row, why)
    print_line(f"The time of row {row} is accepted; the reason stands in the trail.")


@app.command("seal", epilog="Example: betaloop audit seal")
def seal_() -> None:
    """Seal the chain at its end now; the service does so once a minute."""
    with transaction(ACTOR) as db:
        place = seal(db)
    print_line(f"The audit trail is sealed up to link {place}." if place else "The audit trail is empty.")


def sentences(found: Verified) -> list[str]:
    """List what was found, one line each."""
    sealed = f"sealed up to link {found.sealed_to}" if found.sealed_to else "not sealed yet"
    said = [f"The audit trail is whole: {found.links} links, {sealed}."]
    if not found.whole:
        said = [f"The audit trail is broken at {len(found.breaks)} places:", *(f"  {sentence(b)}" for b in found.breaks)]
    return said + [f"Accepted on {a.at:%Y-%m-%d} by {a.by}: {a.reason}\n  {sentence(a.found)}" for a in found.accepted]
