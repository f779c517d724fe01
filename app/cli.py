"""The console command `betaloop`. Exit code 0: done; 1: it failed, for the reason in one line; 2: the call itself is wrong."""

from __future__ import annotations

import signal
import sys
import threading
from collections.abc import Callable
from datetime import datetime
from pathlib import Path
from types import FrameType
from typing import Annotated, Any

import structlog
import typer

from app.accounts import commands as accounts
from app.accounts.permissions import SYSTEM
from app.evaluation.ranking import commands as ranking
from app.ingest import commands as ingest
from app.overview import commands as package
from app.pipeline import commands as next_generation
from app.platform import logs
from app.platform.audit.commands import app as audit_app
from app.platform.bucket import bucket
from app.platform.database import database_place, keep_asking, supervise_database, transaction
from app.platform.terminal import ACTOR, AsJson, Code, say, show
from app.platform.upkeep.commands import app as upkeep_app
from app.platform.upkeep.start import Watchdog, in_one_line, require_data_folder, require_free
from app.settings import Settings, get_settings
from app.simulation import commands as simulation
from app.study import commands as closing
from app.study.commands import participant_app

app = typer.Typer(
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,  # a fault of ours is printed as by Python, in lines that can be searched
    help="betaloop: the study system for closed-loop deep brain stimulation.",
)
study_app = typer.Typer(no_args_is_help=True, help="Whole studies.")
app.add_typer(accounts.user_app, name="user")
app.add_typer(accounts.token_app, name="token")
app.add_typer(study_app, name="study")
control_app = typer.Typer()
app.add_typer(control_app, name="control")
accounts.register(study_app, accounts.user_app)
closing.register(study_app)
app.add_typer(participant_app, name="participant")
simulation.register(study_app)
ingest.register(app)
ranking.register(app)
next_generation.register(app)
package.register_export(app)
package.register_trail(audit_app)
app.add_typer(audit_app, name="audit")
app.add_typer(upkeep_app)

LOOPBACK = ("127.0.0.1", "::1", "localhost")


def decide_cookies(settings: Settings, host: str, *, tls: bool) -> None:
    """Decide whether cookies are limited to HTTPS. They always are with the service's own TLS. Where other machines reach the service they
    are too, unless the settings say otherwise (`BETALOOP_COOKIE_SECURE=false`), which is logged.
    """
    log = structlog.get_logger()
    if tls:
        settings.cookie_secure = True
    elif host not in LOOPBACK and "cookie_secure" not in settings.model_fields_set:
        settings.cookie_secure = True
        log.info("other machines reach this service: people sign in over HTTPS alone, by a TLS proxy or --tls-certificate")
    elif host not in LOOPBACK and not settings.cookie_secure:
        log.warning("other machines reach this service without TLS, as BETALOOP_COOKIE_SECURE=false says: passwords can be read on the way")


def main() -> None:
    """Run a command, and turn errors into one line and an exit code."""
    _end_in_order_on_signals()
    try:
        logs.configure_own()
        app(standalone_mode=True)
    except Exception as error:
        said = in_one_line(error)
        if said is None:
            raise
        say(f"betaloop: {said}")
        sys.exit(1)


@app.command(epilog="Example: betaloop serve --host 0.0.0.0 --port 8000")
def serve(
    host: Annotated[str | None, typer.Option(help="Address to listen on.")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on.")] = None,
    tls_certificate: Annotated[Path | None, typer.Option(exists=True, dir_okay=False, help="Serve over TLS: chain, PEM.")] = None,
    tls_key: Annotated[Path | None, typer.Option(exists=True, dir_okay=False, help="Its private key, PEM.")] = None,
) -> None:
    """Serve the web pages and the REST interface. Jobs need a worker besides (`betaloop worker`)."""
    import uvicorn

    from app.accounts.commands import say_how_to_begin
    from app.accounts.sign_on_provider import configured, provider
    from app.ingest.uploads.interrupted import keep_resuming
    from app.main import create_app
    from app.platform.audit.chain import keep_sealing
    from app.platform.upkeep.migrate import migrate as bring_up_to_date

    logs.configure()
    if (tls_certificate is None) != (tls_key is None):
        raise typer.BadParameter("TLS needs both --tls-certificate and --tls-key")
    settings = get_settings()
    host, port = host or settings.host, settings.port if port is None else port
    require_free(host, port)
    require_data_folder()
    bring_up_to_date()
    decide_cookies(settings, host, tls=tls_certificate is not None)
    if (store := bucket()) is not None:
        store.check_keys(settings)
    supervise_database()
    structlog.get_logger().info("database", lies_in=database_place())
    if configured():
        provider()  # settings that do not fit are reported now, not to the first person who signs on
    service = create_app()
    say_how_to_begin()
    # in parallel to the service, for reading what a crash left behind may take minutes
    threading.Thread(target=keep_resuming, args=("the service", threading.Event()), daemon=True).start()
    threading.Thread(target=keep_sealing, args=(threading.Event(),), daemon=True).start()
    stop = threading.Event()
    watchdog = Watchdog(stop)
    threading.Thread(target=keep_asking, args=(watchdog.beat,), daemon=True).start()

    class Server(uvicorn.Server):
        def handle_exit(self, sig: int, frame: FrameType | None) -> None:
            stop.set()
            super().handle_exit(sig, frame)

    config = uvicorn.Config(
        service, host=host, port=port, log_level=settings.log_level.lower(), access_log=False,
        timeout_graceful_shutdown=3, timeout_keep_alive=75, ssl_certfile=tls_certificate, ssl_keyfile=tls_key,
    )  # fmt: skip
    Server(config).run()


@app.command(epilog="Example: betaloop worker --slots 2")
def worker(slots: Annotated[int | None, typer.Option(min=1, help="Compute steps side by side; BETALOOP_WORKER_SLOTS.")] = None) -> None:
    """Run background jobs until stopped; an interrupted job continues where it was."""
    from app.platform.jobs.worker import run_worker
    from app.platform.upkeep.migrate import migrate as bring_up_to_date

    logs.configure()
    require_data_folder()
    bring_up_to_date()
    if (store := bucket()) is not None:
        store.check_keys(get_settings())
    stop = threading.Event()
    _stop_on_signals(stop)
    supervise_database(stop)
    run_worker(slots or get_settings().worker_slots, stop, beat=Watchdog(stop).beat)


@app.command(epilog="Example: betaloop demo --port 8000")
def demo(
    host: Annotated[str | None, typer.Option(help="Address to listen on.")] = None,
    port: Annotated[int | None, typer.Option(help="Port to listen on.")] = None,
) -> None:
    """Start everything with a small synthetic study: database, web, worker, uploads, and the first ranking."""
    from app.simulation.demo.command import run_demo

    settings = get_settings()
    run_demo(host or settings.host, port or settings.port)


@app.command(epilog="Example: betaloop pipeline P1 --preset quick")
def pipeline(
    code: Code,
    preset: Annotated[
        str | None, typer.Option(help="Named settings of the pipeline: 'quick' for a first look, 'full' for a study.")
    ] = None,
    wait: Annotated[bool, typer.Option(help="Show progress until the job has ended.")] = True,
    again: Annotated[bool, typer.Option("--again", help="Start another although the same one waits or runs.")] = False,
    as_json: AsJson = False,
) -> None:
    """Train, distil, evaluate and rank: the work between two visits. A worker must be running."""
    from app.pipeline.service import start_job
    from app.platform.jobs.watch import follow
    from app.study import repository as study

    params: dict[str, Any] = {} if preset is None else {"preset": preset}
    with transaction(ACTOR) as db:
        person = study.participant_by_code(db, code, SYSTEM)
        started = start_job(db, person, "pipeline", params, SYSTEM, again=again)
        job_id = started.job.id
    if not started.new:
        typer.echo(f"Job {job_id} does this already: no second one was started. Add --again to run it twice.", err=True)
    follow(job_id, wait, as_json)


@control_app.callback(
    invoke_without_command=True,
    epilog="Example: betaloop control --bundle P1-policy-3.zip --source session.zip --speed fast --log decisions.csv",
)
def control_(
    context: typer.Context,
    bundle: Annotated[Path | None, typer.Option(help="Controller bundle; needed.")] = None,
    source: Annotated[str | None, typer.Option(help="Device (-, tcp:PORT, tail:FILE, simulated:P1), recording or cohort:P1.")] = None,
    speed: Annotated[str, typer.Option(help="realtime or fast.")] = "realtime",
    log: Annotated[Path | None, typer.Option(help="CSV of every decision.")] = None,
    key: Annotated[str | None, typer.Option(help="Public key, or a file with it; this installation's own by default.")] = None,
    channel: Annotated[str | None, typer.Option(help="Channel of a recording with several.")] = None,
    beta_source: Annotated[str | None, typer.Option(help="How the beta of a table was made, where not by 'table'.")] = None,
    steps: Annotated[int, typer.Option(min=1, help="Length of a simulated session.")] = 300,
    participant: Annotated[str | None, typer.Option(help="Code of the participant that the bundle must be of.")] = None,
    battery: Annotated[Path | None, typer.Option(help="JSON with assumptions about the implant, for battery life in days.")] = None,
    bench: Annotated[bool, typer.Option("--bench", help="No participant is connected: any bundle runs, on any day.")] = False,
    ledger: Annotated[Path | None, typer.Option(help="Folder with the sessions that this tablet has run.")] = None,
    withdrawn: Annotated[Path | None, typer.Option(help="The study's list of withdrawn policies and plans.")] = None,
    timed: Annotated[int, typer.Option("--time", min=0, max=100_000, help="Time so many decisions on this machine.")] = 0,
    begins: Annotated[datetime | None, typer.Option(help="When a session on a simulated device begins, by its own clock.")] = None,
    as_json: AsJson = False,
) -> None:
    """Verify a controller bundle and run it on a stream of beta, as the tablet does."""
    if context.invoked_subcommand is not None:
        return
    from app.tablet.command import control, lines
    from app.tablet.sources import Task, Wish

    if bundle is None:
        raise typer.BadParameter("Name a controller bundle.", param_hint="--bundle")
    if speed not in ("realtime", "fast"):
        raise typer.BadParameter(f"'{speed}' is neither realtime nor fast.", param_hint="--speed")
    wish = Wish(channel=channel, beta_source=beta_source, steps=steps, realtime=speed == "realtime")
    files = {"log": log, "battery": battery, "ledger": ledger, "withdrawn": withdrawn}
    task = Task(key=key, participant=participant, bench=bench, timed=timed, begins=begins, **files)
    summary = control(bundle, source, wish, task)
    show(summary, as_json, lines(summary))
    if "wrong_signal" in summary or summary.get("failed"):
        raise typer.Exit(1)


@control_app.command("check-port", epilog="Example: betaloop control check-port answers.csv --bundle P1-policy-3.zip --page check.pdf")
def check_port_(
    copy: Annotated[Path, typer.Argument(metavar="ANSWERS", help="CSV of answers; or a copy: .onnx, .tflite, a shared library.")],
    bundle: Annotated[Path, typer.Option(help="Controller bundle.")],
    key: Annotated[str | None, typer.Option(help="Public key, or a file with it; that of this installation by default.")] = None,
    target: Annotated[str | None, typer.Option(help="What was converted, by what: 'TFLite, onnx2tf 1.29.24'.")] = None,
    page: Annotated[Path | None, typer.Option(help="One page for the study's file, .pdf or .html.")] = None,
    answers: Annotated[Path | None, typer.Option(help="CSV of the answers of a copy that ran here, to be uploaded.")] = None,
    as_json: AsJson = False,
) -> None:
    """Check a converted copy of a policy against its bundle: same, within so many mA, or not this policy (exit code 1).

    A shared library is run with your rights: build it from code that you trust.
    """
    from app.tablet.ports import Outputs, check

    found, text, usable = check(copy, bundle, key, Outputs(target, page, answers))
    show(found, as_json, text)
    if not usable:
        raise typer.Exit(1)


def _end_in_order_on_signals() -> None:
    """Let a stop from outside end the process as any other end does, so that the embedded PostgreSQL is stopped and not left behind."""

    def end(number: int, _frame: Any) -> None:
        raise SystemExit(128 + number)

    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGHUP, end)


def _stop_on_signals(stop: threading.Event) -> None:
    handler: Callable[[int, Any], None] = lambda _number, _frame: stop.set()  # noqa: E731
    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, handler)


if __name__ == "__main__":
    main()
