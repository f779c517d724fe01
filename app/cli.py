"""The console command `betaloop`. Exit code 0: done; 1: it could not be done, said in one line; 2: the call itself is wrong."""

from __future__ import annotations

import json
import signal
import sys
import threading
from collections.abc import Callable
from datetime import datetime
from getpass import getpass
from pathlib import Path
from typing import Annotated, Any

import structlog
import typer
from rich.console import Console
from rich.table import Table

from app.accounts import service as accounts
from app.accounts.models import Role, Scope
from app.accounts.permissions import SYSTEM
from app.accounts.studies import commands as studies
from app.pipeline.next_generation import commands as next_generation
from app.platform import logs
from app.platform.audit.commands import app as audit_app
from app.platform.database import database_place, supervise_database, transaction
from app.platform.errors import BetaloopError
from app.platform.tables import load_tables
from app.platform.upkeep.commands import app as upkeep_app
from app.settings import get_settings

app = typer.Typer(no_args_is_help=True, add_completion=False, help="betaloop: the study system for closed-loop deep brain stimulation.")
user_app = typer.Typer(no_args_is_help=True, help="Users.")
token_app = typer.Typer(no_args_is_help=True, help="API tokens.")
study_app = typer.Typer(no_args_is_help=True, help="Whole studies.")
ingest_app = typer.Typer(no_args_is_help=True, help="Stored uploads.")
app.add_typer(user_app, name="user")
app.add_typer(token_app, name="token")
app.add_typer(study_app, name="study")
app.add_typer(ingest_app, name="ingest")
studies.register(study_app, user_app)
next_generation.register(app)
app.add_typer(audit_app, name="audit")
app.add_typer(upkeep_app)

AsJson = Annotated[bool, typer.Option("--json", help="Print the result as JSON.")]
Code = Annotated[str, typer.Argument(help="Code of the participant, e.g. P1.")]
ACTOR = "command line"
LOOPBACK = ("127.0.0.1", "::1", "localhost")


def main() -> None:
    """Entry point: runs a command and turns errors into one line and an exit code."""
    _end_in_order_on_signals()
    load_tables()
    try:
        logs.configure_own()
        app(standalone_mode=True)
    except (BetaloopError, RuntimeError) as error:
        _say(f"betaloop: {error}")
        sys.exit(1)


@app.command(epilog="Example: betaloop serve --host 0.0.0.0 --port 8000")
def serve(
    host: Annotated[str | None, typer.Option(help="Address to listen on.")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on.")] = None,
    tls_certificate: Annotated[Path | None, typer.Option(exists=True, dir_okay=False, help="Serve over TLS: chain, PEM.")] = None,
    tls_key: Annotated[Path | None, typer.Option(exists=True, dir_okay=False, help="Its private key, PEM.")] = None,
) -> None:
    """Serve the web pages and the REST interface. Jobs need a worker beside it (`betaloop worker`)."""
    import uvicorn

    from app.ingest.uploads.interrupted import keep_resuming
    from app.main import create_app
    from app.platform.audit.chain import keep_sealing
    from app.platform.jobs.children import limited
    from app.platform.migrate import migrate as bring_up_to_date

    logs.configure()
    if (tls_certificate is None) != (tls_key is None):
        raise typer.BadParameter("TLS needs both --tls-certificate and --tls-key")
    bring_up_to_date()
    settings = get_settings()
    if tls_certificate is not None:
        settings.cookie_secure = True
    supervise_database()
    structlog.get_logger().info("database", lies_in=database_place())
    if (host or settings.host) not in LOOPBACK and not settings.cookie_secure:
        structlog.get_logger().warning(
            "other machines reach this service without TLS: give --tls-certificate, or use a TLS proxy and set BETALOOP_COOKIE_SECURE"
        )
    service = create_app()
    limited.prepare()  # before the first upload, which would wait for it
    # beside the service, for reading what a crash left behind may take minutes
    threading.Thread(target=keep_resuming, args=("the service", threading.Event()), daemon=True).start()
    threading.Thread(target=keep_sealing, args=(threading.Event(),), daemon=True).start()
    uvicorn.run(
        service, host=host or settings.host, port=port or settings.port, log_level=settings.log_level.lower(), access_log=False,
        timeout_graceful_shutdown=3, timeout_keep_alive=75, ssl_certfile=tls_certificate, ssl_keyfile=tls_key,
    )  # fmt: skip


@app.command(epilog="Example: betaloop worker --slots 2")
def worker(slots: Annotated[int | None, typer.Option(min=1, help="Compute steps side by side; BETALOOP_WORKER_SLOTS.")] = None) -> None:
    """Run background jobs until stopped; an interrupted job continues where it was."""
    from app.platform.jobs.worker import run_worker
    from app.platform.migrate import migrate as bring_up_to_date

    logs.configure()
    bring_up_to_date()
    stop = threading.Event()
    _stop_on_signals(stop)
    supervise_database(stop)
    run_worker(slots or get_settings().worker_slots, stop)


@app.command(epilog="Example: betaloop demo --port 8000")
def demo(
    host: Annotated[str | None, typer.Option(help="Address to listen on.")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on.")] = None,
) -> None:
    """Start everything with a small synthetic study: database, web, worker, uploads, and the first ranking."""
    from app.simulation.demo import run_demo

    settings = get_settings()
    run_demo(host or settings.host, port or settings.port)


@user_app.command("add", epilog="Example: betaloop user add ada@clinic.example --role clinician")
def user_add(
    email: Annotated[str, typer.Argument(help="E-mail address to sign in with.")],
    role: Annotated[Role, typer.Option(help=", ".join(Role))],
    study: Annotated[str | None, typer.Option(help="Code of the study, where there are several.")] = None,
    password_file: Annotated[Path | None, typer.Option(help="File with the password; asked for when left out ('-': stdin).")] = None,
    as_json: AsJson = False,
) -> None:
    """Add a user with a role in a study."""
    password = _password(password_file)
    with transaction(ACTOR) as db:
        user = accounts.add_user(db, email, role, password, study)
        result = {"id": user.id, "email": user.email, "role": role.value}
    _print(result, as_json, f"Added {result['email']} as {role.value}.")


@token_app.command("create", epilog="Example: betaloop token create ada@clinic.example --name upload-tablet")
def token_create(
    email: Annotated[str, typer.Argument(help="E-mail address of the user.")],
    name: Annotated[str, typer.Option(help="What will use the token.")],
    scope: Annotated[Scope, typer.Option(help="What it may do of what the user may.")] = Scope.FULL,
    days: Annotated[int, typer.Option(help="Days after which it ends.")] = accounts.TOKEN_DAYS,
    as_json: AsJson = False,
) -> None:
    """Make an API token and print it; it is shown this once."""
    with transaction(ACTOR) as db:
        token = accounts.create_token(db, email, name, scope, days)
    _print({"email": email, "name": name, "token": token}, as_json, token)


@app.command("import", epilog="Example: betaloop import session.zip --participant P1 --visit 2 --controller random")
def import_(
    path: Annotated[
        Path, typer.Argument(exists=True, dir_okay=False, help="A zip of an RC+S session folder, a Percept report, a table, an export.")
    ],
    participant: Annotated[str, typer.Option(help="Code of the participant.")],
    visit: Annotated[int | None, typer.Option(min=1, help="Number of the visit; left out, it is proposed by its date.")] = None,
    controller: Annotated[
        str | None, typer.Option(help="cdbs, rl, distilled, no_dbs, random or other; left out, sessions are proposed.")
    ] = None,
    policy: Annotated[str | None, typer.Option(help="Name or number of the policy that ran.")] = None,
    started_at: Annotated[datetime | None, typer.Option(help="Start of the session, UTC.")] = None,
    beta_unit: Annotated[str | None, typer.Option(help="Unit of a table's beta; the participant's when left out.")] = None,
    as_json: AsJson = False,
) -> None:
    """Import a file, as an upload does: with visit and controller its sessions count at once, else they wait for confirmation."""
    from app.ingest.uploads import api, service
    from app.study import repository as study
    from app.study.models import Controller

    if controller is not None and controller not in set(Controller):
        raise typer.BadParameter(f"'{controller}' is none of {', '.join(Controller)}.", param_hint="--controller")
    with transaction(ACTOR) as db, path.open("rb") as stream:
        person = study.participant_by_code(db, participant, SYSTEM)
        arm = Controller(controller) if controller is not None else None
        stated = service.state_session(db, person, visit, arm, policy, started_at)
        outcome = service.receive(db, person, stated, [service.Incoming(path.name, stream)], SYSTEM, service.BetaStated(beta_unit))
        if not outcome.usable:
            raise api.unusable(outcome)
        answer = api.upload_out(db, outcome, SYSTEM).model_dump(mode="json")
    lines = [f"{r['name']}: {s}" for r in answer["report"] for key in ("understood", "repaired", "flagged", "removed") for s in r[key]]
    _print(answer, as_json, "\n".join(lines))


@ingest_app.command("redecode", epilog="Example: betaloop ingest redecode --participant P1 --dry-run")
def redecode_(
    participant: Annotated[str | None, typer.Option(help="Code of a participant; every one when left out.")] = None,
    upload_file: Annotated[int | None, typer.Option(min=1, help="Number of one file, from its upload's page.")] = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Tell what would change, and change nothing.")] = False,
    as_json: AsJson = False,
) -> None:
    """Read stored files with the present decoder; sessions use what it gives from then on, snapshots keep what they pin."""
    from app.ingest.uploads.redecode import redecode
    from app.study import repository as study

    with transaction(ACTOR) as db:
        only = study.participant_by_code(db, participant, SYSTEM).id if participant else None
    table = Table("file", "participant", "kind", "state", "what changed" if not dry_run else "what would change")
    changes = list(redecode(only, upload_file, dry_run, ACTOR))
    for c in changes:
        table.add_row(str(c.upload_file_id), c.participant, c.kind, c.state, "\n".join(c.said))
    if as_json:
        _print({"dry_run": dry_run, "files": [vars(c) for c in changes]}, True, "")
    else:
        Console().print(table)
    if any(c.state == "failed" for c in changes):
        raise typer.Exit(1)


@ingest_app.command("resume", epilog="Example: betaloop ingest resume")
def resume_() -> None:
    """Resume uploads that a stop of the service cut short; the service does so itself when it starts."""
    from app.ingest.uploads.interrupted import resume

    taken = list(resume(ACTOR))
    for one in taken:
        typer.echo(f"Upload {one.upload_id}: {one.message}")
    if not taken:
        typer.echo("No upload was cut short.")
    if any(not one.done for one in taken):
        raise typer.Exit(1)


@app.command(epilog="Example: betaloop pipeline P1 --preset quick")
def pipeline(
    code: Code,
    preset: Annotated[
        str | None, typer.Option(help="Named settings of the pipeline: 'quick' for a first look, 'full' for a study.")
    ] = None,
    wait: Annotated[bool, typer.Option(help="Show progress until the job has ended.")] = True,
    as_json: AsJson = False,
) -> None:
    """Train, distil, evaluate and rank: the work between two visits. A worker must be running."""
    from app.pipeline.service import start_job
    from app.platform.jobs.watch import follow
    from app.study import repository as study

    params: dict[str, Any] = {} if preset is None else {"preset": preset}
    with transaction(ACTOR) as db:
        person = study.participant_by_code(db, code, SYSTEM)
        job_id = start_job(db, person, "pipeline", params, SYSTEM).id
    follow(job_id, wait, as_json)


@app.command(epilog="Example: betaloop rank P1")
def rank(code: Code, as_json: AsJson = False) -> None:
    """Print the ranked policies of a participant."""
    from app.evaluation.ranking.service import current_ranking
    from app.study import repository as study

    with transaction(ACTOR) as db:
        body = current_ranking(db, study.participant_by_code(db, code, SYSTEM), SYSTEM).model_dump(mode="json")
    if as_json:
        _print(body, True, "")
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


@study_app.command("simulate", epilog="Example: betaloop study simulate --participants P1 --preset quick")
def simulate(
    visits: Annotated[int | None, typer.Option(min=2, max=60, help="Visits of each participant; the preset's when left out.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of everything random in the study.")] = 0,
    participants: Annotated[str, typer.Option(help="Codes of synthetic participants, with commas between them.")] = "P1,P2,P3,P4",
    preset: Annotated[str, typer.Option(help="'quick': for a first look; 'full': about the paper's trial time.")] = "quick",
    as_json: AsJson = False,
) -> None:
    """Run the whole trial loop on synthetic participants, who are not fitted to patients; started again, it goes on where it was."""
    from app.platform.migrate import migrate as bring_up_to_date
    from app.simulation.design import design
    from app.simulation.report import as_dict, as_table
    from app.simulation.run import simulate as run_study

    wanted = design(participants.split(","), visits, seed, preset)
    bring_up_to_date()
    caller = run_study(wanted)
    with transaction(ACTOR) as db:
        table = as_table(db, wanted.participants, caller)
        result = as_dict(db, wanted.participants, caller)
    if as_json:
        _print(result, True, "")
    else:
        Console().print(table)


@app.command("export", epilog="Example: betaloop export P1 --to p1.zip")
def export_(
    code: Code,
    to: Annotated[Path | None, typer.Option(help="Zip to write; CODE.zip when left out.")] = None,
    as_json: AsJson = False,
) -> None:
    """Write everything of a participant as a zipped Frictionless data package, with a script that recomputes its primary tables."""
    from app.overview.package.export import export_participant
    from app.study import repository as study

    target = to or Path(f"{code}.zip")
    if target.is_dir() or not target.parent.is_dir():
        raise _bad_call(
            f"{target} cannot be written: " + ("it is a folder." if target.is_dir() else f"there is no folder {target.parent}.")
        )
    with transaction(ACTOR) as db:
        content = export_participant(db, study.participant_by_code(db, code, SYSTEM), SYSTEM)
    try:
        target.write_bytes(content)
    except OSError as error:
        _say(f"betaloop: {target} cannot be written: {_reason(error)}.")
        raise typer.Exit(1) from error
    _print({"path": str(target), "bytes": len(content)}, as_json, f"Wrote {target} ({len(content)} bytes).")


@app.command("control", epilog="Example: betaloop control --bundle P1-policy-3.zip --source session.zip --speed fast --log decisions.csv")
def control_(
    bundle: Annotated[Path, typer.Option(help="Controller bundle.")],
    source: Annotated[str | None, typer.Option(help="Device (-, tcp:PORT, tail:FILE, simulated:P1), recording or cohort:P1.")] = None,
    speed: Annotated[str, typer.Option(help="realtime or fast.")] = "realtime",
    log: Annotated[Path | None, typer.Option(help="CSV of every decision.")] = None,
    key: Annotated[str | None, typer.Option(help="Public key, or a file with it; this installation's own when left out.")] = None,
    channel: Annotated[str | None, typer.Option(help="Channel of a recording with several.")] = None,
    beta_source: Annotated[str | None, typer.Option(help="How the beta of a table was made, where not by 'table'.")] = None,
    steps: Annotated[int, typer.Option(min=1, help="Length of a simulated session.")] = 300,
    participant: Annotated[str | None, typer.Option(help="Code of the participant that the bundle must be of.")] = None,
    battery: Annotated[Path | None, typer.Option(help="JSON with assumptions about the implant, for battery life in days.")] = None,
    bench: Annotated[bool, typer.Option("--bench", help="Nobody is connected: any bundle runs, on any day.")] = False,
    ledger: Annotated[Path | None, typer.Option(help="Folder with the sessions that this tablet has run.")] = None,
    withdrawn: Annotated[Path | None, typer.Option(help="The study's list of withdrawn policies and plans.")] = None,
    timed: Annotated[int, typer.Option("--time", min=0, max=100_000, help="Time so many decisions on this machine.")] = 0,
    begins: Annotated[datetime | None, typer.Option(help="When a session on a simulated device begins, by its own clock.")] = None,
    as_json: AsJson = False,
) -> None:
    """Verify a controller bundle and run it on a stream of beta, as the tablet does."""
    from app.tablet.command import control, lines
    from app.tablet.sources import Wish
    from app.tablet.task import Task

    if speed not in ("realtime", "fast"):
        raise typer.BadParameter(f"'{speed}' is neither realtime nor fast.", param_hint="--speed")
    wish = Wish(channel=channel, beta_source=beta_source, steps=steps, realtime=speed == "realtime")
    files = {"log": log, "battery": battery, "ledger": ledger, "withdrawn": withdrawn}
    task = Task(key=key, participant=participant, bench=bench, timed=timed, begins=begins, **files)
    summary = control(bundle, source, wish, task)
    _print(summary, as_json, lines(summary))
    if "wrong_signal" in summary or summary.get("failed"):
        raise typer.Exit(1)


def _estimate_cells(estimate: dict[str, Any]) -> tuple[str, str, str]:
    interval = f"{estimate['low']:.2f} … {estimate['high']:.2f}"
    return f"{estimate['value']:.2f}", interval, "yes" if estimate.get("supported", True) else "no"


def _password(path: Path | None) -> str:
    if path is None:
        if not sys.stdin.isatty():
            raise typer.BadParameter("No terminal to ask for a password.", param_hint="--password-file")
        return getpass("Password: ")
    if str(path) == "-":
        return sys.stdin.readline().rstrip("\r\n")
    try:
        return path.read_text("utf-8").rstrip("\r\n")
    except (OSError, UnicodeDecodeError) as error:
        raise _bad_call(f"The password file {path} cannot be read: {_reason(error)}.") from error


def _bad_call(text: str) -> typer.Exit:
    """Say in a line what is wrong with the call; to be raised."""
    _say(f"betaloop: {text}")
    return typer.Exit(2)


def _reason(error: Exception) -> str:
    return (error.strerror if isinstance(error, OSError) else None) or str(error)


def _end_in_order_on_signals() -> None:
    """Have a stop from outside end the process as any other end does, so that the embedded PostgreSQL is stopped and not left behind."""

    def end(number: int, _frame: Any) -> None:
        raise SystemExit(128 + number)

    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGHUP, end)


def _stop_on_signals(stop: threading.Event) -> None:
    handler: Callable[[int, Any], None] = lambda _number, _frame: stop.set()  # noqa: E731
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, handler)


def _print(result: dict[str, Any], as_json: bool, text: str) -> None:
    print(json.dumps(result, default=str) if as_json else text)  # noqa: T201


def _say(text: str) -> None:
    print(text, file=sys.stderr)  # noqa: T201


if __name__ == "__main__":
    main()
