"""Commands of the audit trail: `betaloop audit verify` and `betaloop audit seal`."""

from __future__ import annotations

from dataclasses import asdict

import typer

from app.platform.audit.breaks import sentence
from app.platform.audit.chain import Verified, seal, verify
from app.platform.database import new_session, transaction
from app.platform.terminal import ACTOR, AsJson, print_line, show

app = typer.Typer(no_args_is_help=True, help="The audit trail.")


@app.command("verify", epilog="Example: betaloop audit verify")
def verify_(as_json: AsJson = False) -> None:
    """Compute the hash chain of the audit trail again and hold its seals against it; exit code 1 where it is broken."""
    with new_session() as db:
        found = verify(db)
    show(asdict(found) | {"whole": found.whole}, as_json, "\n".join(sentences(found)))
    if not found.whole:
        raise typer.Exit(1)


@app.command("seal", epilog="Example: betaloop audit seal")
def seal_() -> None:
    """Seal the chain at its end now; the service does so once a minute."""
    with transaction(ACTOR) as db:
        place = seal(db)
    print_line(f"The audit trail is sealed up to link {place}." if place else "The audit trail is empty.")


def sentences(found: Verified) -> list[str]:
    """What was found, a line each."""
    if found.whole:
        sealed = f"sealed up to link {found.sealed_to}" if found.sealed_to else "not sealed yet"
        return [f"The audit trail is whole: {found.links} links, {sealed}."]
    return [f"The audit trail is broken at {len(found.breaks)} places:", *(f"  {sentence(b)}" for b in found.breaks)]
