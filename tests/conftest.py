"""Fixtures of the whole suite: a real PostgreSQL built by Alembic, a database per test, the service, its users, the recordings."""

from __future__ import annotations

import gc
import os
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import mkdtemp

import anyio.from_thread
import psycopg
import pytest
from alembic import command
from alembic.config import Config
from fastapi.testclient import TestClient
from httpx2 import Response
from hypothesis import settings
from pwdlib import PasswordHash
from sqlalchemy import create_engine
from sqlalchemy.orm import Session

import app.platform.database as database
from app.accounts import service as accounts
from app.accounts.pages import failed_sign_ins
from app.accounts.passwords import FewAtOnce
from app.platform import service_role
from app.platform.embedded.server import EmbeddedPostgres
from app.platform.jobs import engine as jobs_engine
from app.platform.web.request_bodies import sent
from app.settings import get_settings
from app.tables.accounts import Role

# Machines that are busy with other work make single examples slow; in CI the same examples are drawn every time.
settings.register_profile("betaloop", deadline=None, derandomize=bool(os.environ.get("CI")))
settings.load_profile("betaloop")

# Jobs of tests step back behind nothing: on a machine that is busy with other work they would hardly go on.
os.environ.setdefault("BETALOOP_JOB_NICENESS", "0")

# A test that asks for no database may not use the checkout's own installation, nor leave one behind: nothing can be made below a device.
os.environ["BETALOOP_DATA_DIR"] = "/dev/null/of-no-test"

ROOT = Path(__file__).resolve().parents[1]
PASSWORD = "correct horse battery"
MEMORY = Path("/dev/shm")
ROOM_IN_MEMORY = 2 << 30
"""Free bytes that databases in memory need, so that nothing else has to leave it: a worker uses up to a few hundred MiB."""


pytest_plugins = ["tests.hazard_marks"]

gc.disable()  # what is loaded to collect the tests stays: to look through it meanwhile takes a quarter of the time


@pytest.hookimpl(tryfirst=True)
def pytest_runtestloop() -> None:
    """Search from now on what tests make, and only that, as seldom as the service does."""
    gc.freeze()
    gc.set_threshold(10_000, 20, 20)
    gc.enable()


@pytest.fixture(scope="session")
def recordings() -> Path:
    """Folder of real device recordings; where it is absent the test is skipped."""
    folder = Path(os.environ.get("BETALOOP_TEST_DATA", ROOT.parent / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip("no recordings here: set BETALOOP_TEST_DATA to their folder")
    return folder


def database_folder(tmp_path_factory: pytest.TempPathFactory, memory: Path = MEMORY) -> Path:
    """Make a new folder for the databases of this process: in memory where there is room for them, else on the disk.

    Every test gets a copy of 730 files, which took a disk a quarter of the processor time of the whole suite.
    """
    if not memory.is_dir() or not os.access(memory, os.W_OK) or shutil.disk_usage(memory).free < ROOM_IN_MEMORY:
        return tmp_path_factory.mktemp("database")
    for left in memory.glob("betaloop-tests-*-*"):  # by a run that was killed: on a disk it would do no harm
        if not Path("/proc", left.name.split("-")[2]).exists():
            EmbeddedPostgres(left / "postgres", durable=False, server_user=get_settings().server_user).remove()
            shutil.rmtree(left, ignore_errors=True)
    folder = Path(mkdtemp(prefix=f"betaloop-tests-{os.getpid()}-", dir=memory))
    folder.chmod(0o711)  # PostgreSQL's own user passes through
    return folder


@pytest.fixture(scope="session")
def server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmbeddedPostgres]:
    """A PostgreSQL of this test run with a migrated template database."""
    folder = database_folder(tmp_path_factory)
    server = EmbeddedPostgres(folder / "postgres", durable=False, server_user=get_settings().server_user)
    server.start()
    engine = create_engine(server.owner_url("betaloop"))
    with engine.begin() as connection:
        config = Config(str(ROOT / "alembic.ini"))
        config.set_main_option("script_location", str(ROOT / "migrations"))
        config.attributes["connection"] = connection
        command.upgrade(config, "head")
    jobs_engine.prepare(server.owner_url("betaloop"))
    with engine.begin() as connection:
        service_role.grant(connection, "betaloop_service", None)
    engine.dispose()
    yield server
    for connection in _administrators.values():
        connection.close()
    _administrators.clear()
    server.remove()
    shutil.rmtree(folder, ignore_errors=True)


_open: list[str] = []
"""Databases of tests that are in use now: more than one where a template is made within a test."""

_administrators: dict[str, psycopg.Connection] = {}


def _administer(server: EmbeddedPostgres, statement: str) -> None:
    """Execute a statement as the server's administrator, over one connection for all tests: to connect twice for each takes longer."""
    conninfo = server.admin_conninfo()
    try:
        if conninfo not in _administrators:
            _administrators[conninfo] = psycopg.connect(conninfo, autocommit=True)
        _administrators[conninfo].execute(statement)
    except psycopg.OperationalError:  # a test has killed the server meanwhile
        _administrators.pop(conninfo).close()
        _administrators[conninfo] = psycopg.connect(conninfo, autocommit=True)
        _administrators[conninfo].execute(statement)


def copy_database(server: EmbeddedPostgres, name: str, template: str) -> None:
    """Create a database with the content of another one without connections."""
    _administer(server, f"create database {name} template {template} owner betaloop strategy file_copy")


def drop_database(server: EmbeddedPostgres, name: str) -> None:
    """Remove a database where it is there, even with connections."""
    _administer(server, f"drop database if exists {name} with (force)")


def close_connections() -> None:
    """Close this process's connections to the database in use, so that it can be copied.

    The engines stay: each test's database has the name of the last one's, and what was compiled for that one's queries serves this one's.
    """
    for engine in database._engines.values():
        engine.dispose()
    for client in jobs_engine._clients.values():
        client.destroy()
    jobs_engine._clients.clear()


@contextmanager
def own_database(server: EmbeddedPostgres, data: Path, monkeypatch: pytest.MonkeyPatch, template: str, keep: str = "") -> Iterator[str]:
    """Make a database and data folder of one test, named in the environment too, so that child processes find them.

    Args:
        keep: the name of a copy that is left at the end, a template for other tests; `data` is left with it.
    """
    name = f"test_{os.getpid()}_{len(_open)}"
    _open.append(name)
    copy_database(server, name, template)
    url = server.url(name)
    monkeypatch.setenv("BETALOOP_DATABASE_URL", url)
    monkeypatch.setenv("BETALOOP_OWNER_URL", server.owner_url(name))
    monkeypatch.setenv("BETALOOP_DATA_DIR", str(data))
    get_settings.cache_clear()
    try:
        yield url
        close_connections()
        if keep:
            drop_database(server, keep)  # of a making that was cut short, which pytest begins again
            copy_database(server, keep, name)
    finally:
        close_connections()
        get_settings.cache_clear()
        if not keep:
            shutil.rmtree(data, ignore_errors=True)
        drop_database(server, name)
        _open.pop()


Template = tuple[str, Path]
"""A database without connections, and its data folder; tests work on copies."""


@dataclass(frozen=True)
class Begun:
    """Start of a test that uses `participant_code`: an administrator and a participant, made once.

    Attributes:
        token: of the administrator.
    """

    template: Template
    token: str


@pytest.fixture(scope="session")
def begun_once(server: EmbeddedPostgres, application, tmp_path_factory: pytest.TempPathFactory) -> Begun:  # type: ignore[no-untyped-def]
    """The administrator of `client`, and the participant of `participant_code`."""
    data = tmp_path_factory.mktemp("begun") / "data"
    data.mkdir()
    with pytest.MonkeyPatch.context() as patch, own_database(server, data, patch, "betaloop", keep="begun"):
        token = _token_of("admin")
        _enrol(TestClient(application, headers={"Authorization": f"Bearer {token}"}))
    return Begun(("begun", data), token)


@pytest.fixture
def begun(request: pytest.FixtureRequest) -> Begun | None:
    """Start of the test; None where it uses no participant, only in its course, or a synthetic one."""
    ready = "participant_code" in request.fixturenames and request.node.get_closest_marker("synthetic") is None
    return request.getfixturevalue("begun_once") if ready else None


@pytest.fixture
def fresh_database(begun: Begun | None, server: EmbeddedPostgres, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A database at the newest schema: empty, or what a test with a participant begins with."""
    copied = copy_of(begun.template, server, tmp_path, monkeypatch) if begun else None
    with copied or own_database(server, tmp_path / "data", monkeypatch, "betaloop") as url:
        yield url


@contextmanager
def copy_of(template: Template, server: EmbeddedPostgres, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Copy a template for one test."""
    shutil.copytree(template[1], tmp_path / "data")
    with own_database(server, tmp_path / "data", monkeypatch, template[0]) as url:
        yield url


@pytest.fixture(autouse=True, scope="session")
def cheap_passwords() -> None:
    """Argon2 as in the service, at a cost that hundreds of tests can bear."""
    accounts._hasher = PasswordHash((FewAtOnce(time_cost=1, memory_cost=64, parallelism=1),))
    accounts._decoy.cache_clear()


@pytest.fixture(autouse=True, scope="session")
def one_event_loop() -> Iterator[None]:
    """The event loop of every client of this process: to start one for each request, or client, takes as long as a small request."""
    with anyio.from_thread.start_blocking_portal() as portal, pytest.MonkeyPatch.context() as patch:
        patch.setattr(TestClient, "portal", portal)
        yield


@pytest.fixture(autouse=True)
def new_sources() -> None:
    """Limits by source, reset so that no test's use counts against the next one."""
    failed_sign_ins.forget()
    sent.forget()


@pytest.fixture
def data_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """A data folder without a database, for a test that stores files alone."""
    monkeypatch.setenv("BETALOOP_DATA_DIR", str(tmp_path / "data"))
    get_settings.cache_clear()
    yield tmp_path / "data"
    get_settings.cache_clear()


@pytest.fixture
def db(fresh_database: str) -> Iterator[Session]:
    """A session on the test's database, acting as 'test'."""
    with database.new_session() as session:
        database.set_actor(session, "test")
        yield session


@pytest.fixture
def owner_db(fresh_database: str) -> Iterator[Session]:
    """A session of the role that owns the tables, for what no service may do; acts as 'owner'."""
    engine = create_engine(database.owner_url())
    with Session(engine, expire_on_commit=False) as session:
        database.set_actor(session, "owner")
        yield session
    engine.dispose()


def _token_of(role: str) -> str:
    with database.transaction("test") as db:
        accounts.add_user(db, f"{role}@clinic.example", Role(role), PASSWORD)
        return accounts.create_token(db, f"{role}@clinic.example", "tests")


@pytest.fixture
def make_token(fresh_database: str) -> Callable[[str], str]:
    """Function that makes a user of a role and returns an API token."""
    return _token_of


@pytest.fixture(scope="session")
def application():  # type: ignore[no-untyped-def]
    """The web service, built once: it holds no state, and building it with its first request costs half a second of a processor."""
    from app.main import create_app

    return create_app()


@pytest.fixture
def service_app(application, fresh_database: str):  # type: ignore[no-untyped-def]
    """The web service on the test's database; a route that a test adds goes with it."""
    routes = list(application.router.routes)
    yield application
    application.router.routes[:] = routes


@pytest.fixture
def client(service_app, fresh_database: str, begun: Begun | None) -> TestClient:  # type: ignore[no-untyped-def]
    """A client that calls as an administrator."""
    return TestClient(service_app, headers={"Authorization": f"Bearer {begun.token if begun else _token_of('admin')}"})


@pytest.fixture
def client_as(service_app, make_token: Callable[[str], str]) -> Callable[[str], TestClient]:  # type: ignore[no-untyped-def]
    """Clients by role: viewer, clinician, engineer, admin. The service they call was not started: test_incoming_files.py does it."""

    def make(role: str) -> TestClient:
        return TestClient(service_app, headers={"Authorization": f"Bearer {make_token(role)}"})

    return make


@pytest.fixture
def sign_plan(service_app, fresh_database: str) -> Callable[..., Response]:  # type: ignore[no-untyped-def]
    """Function that signs a visit's plan over REST as a clinician who drafts nothing."""
    with database.transaction("test") as db:
        accounts.add_user(db, "signer@clinic.example", Role.CLINICIAN, PASSWORD)
        token = accounts.create_token(db, "signer@clinic.example", "tests")
    signer = TestClient(service_app, headers={"Authorization": f"Bearer {token}"})

    def sign(visit_id: int, **more: object) -> Response:
        return signer.post(f"/api/v1/visits/{visit_id}/plan/approve", json={"password": PASSWORD, **more})

    return sign


def _enrol(client: TestClient, synthetic: bool = False) -> None:
    body = {
        "code": "P1",
        "synthetic": synthetic,
        "settings": {"xi_beta": 1.0, "cdbs_amplitude_ma": 3.0, "beta_unit": "uV", "beta_source": "table"},
    }
    assert client.post("/api/v1/participants", json=body).status_code == 201
    assert client.post("/api/v1/participants/P1/visits", json={"number": 1, "date": "2026-03-02"}).status_code == 201


@pytest.fixture
def participant_code(client: TestClient, begun: Begun | None, request: pytest.FixtureRequest) -> str:
    """Code of a participant with a cDBS amplitude and a threshold, and a visit 1; a synthetic one by the marker of that name."""
    if begun is None:
        _enrol(client, request.node.get_closest_marker("synthetic") is not None)
    return "P1"
