"""Requirements of a start are checked first, and every command that cannot be carried out says why in a line."""

from __future__ import annotations

import os
import socket
from pathlib import Path

import pytest
from pydantic import ValidationError
from sqlalchemy import create_engine
from sqlalchemy.exc import OperationalError, ProgrammingError

from app.platform.errors import Conflict
from app.platform.upkeep.start import in_one_line, require_data_folder, require_free
from app.settings import Settings, get_settings
from tests.ports import free_port


def test_a_taken_port_is_named_with_what_to_do() -> None:
    with socket.create_server(("127.0.0.1", free_port())) as other:
        port = other.getsockname()[1]
        for host in ("127.0.0.1", "localhost", "0.0.0.0"):
            with pytest.raises(Conflict, match=rf"{port}: another program listens there\. .*--port \d+\.") as refused:
                require_free(host, port)
            free = int(str(refused.value).rpartition("--port ")[2].rstrip("."))
            assert free > port
            require_free(host, free)
    require_free("127.0.0.1", port)


LOCAL = [(socket.AF_INET6, ("::1", 0, 0, 0)), (socket.AF_INET, ("127.0.0.1", 0))]


@pytest.mark.parametrize("order", [LOCAL, LOCAL[::-1]])
def test_a_name_of_several_addresses_is_asked_at_each_and_one_that_the_machine_lacks_is_no_fault(
    order: list[tuple[int, tuple[object, ...]]], monkeypatch: pytest.MonkeyPatch
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        found = [(family, socket.SOCK_STREAM, 6, "", (address[0], port, *address[2:])) for family, address in order]
        monkeypatch.setattr(socket, "getaddrinfo", lambda *_, **__: found)
        with pytest.raises(Conflict, match=f"{port}: another program listens there"):
            require_free("localhost", port)
    lacked = (socket.AF_INET, socket.SOCK_STREAM, 6, "", ("192.0.2.1", port))
    found[order.index(LOCAL[0])] = lacked
    require_free("localhost", port)
    found[:] = [lacked]
    with pytest.raises(Conflict, match="this machine has no such address"):
        require_free("localhost", port)


@pytest.mark.parametrize("address", [("192.0.2.1", 8000), ("nowhere.invalid", 8000), ("127.0.0.1", 65536), ("127.0.0.1", -1), ("..", 8000)])
def test_an_address_that_this_machine_does_not_have_is_refused(address: tuple[str, int]) -> None:
    with pytest.raises(Conflict, match="no such address"):
        require_free(*address)


def test_a_data_folder_that_is_a_file_or_belongs_to_another_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "file").write_text("")
    monkeypatch.setattr(get_settings(), "data_dir", tmp_path / "file")
    with pytest.raises(FileExistsError) as found:
        require_data_folder()
    assert str(in_one_line(found.value)).startswith(f"{tmp_path / 'file'}: File exists. There is a file where a folder is wanted")
    closed = Path("/proc")  # where root may make no file either
    monkeypatch.setattr(get_settings(), "data_dir", closed)
    with pytest.raises(OSError) as found_closed:
        require_data_folder()
    assert found_closed.value.filename == str(closed)
    monkeypatch.setattr(get_settings(), "data_dir", tmp_path / "new" / "folder")
    require_data_folder()
    assert os.listdir(tmp_path / "new" / "folder") == []


def test_a_database_that_is_not_there_is_told_in_a_line_without_its_password(monkeypatch: pytest.MonkeyPatch) -> None:
    url = f"postgresql+psycopg://somebody:secret@127.0.0.1:{free_port()}/clinic"
    monkeypatch.setattr(get_settings(), "database_url", url)
    with pytest.raises(OperationalError) as found:
        create_engine(url).connect()
    said = str(in_one_line(found.value))
    assert said.endswith("`betaloop where` reads them.")
    assert "Connection refused. Start it, or correct BETALOOP_DATABASE_URL" in said
    assert "secret" not in said
    assert "\n" not in said


def test_a_setting_that_cannot_be_read_is_named_as_the_environment_has_it() -> None:
    with pytest.raises(ValidationError) as found:
        Settings(port="abc")
    assert str(in_one_line(found.value)).startswith("BETALOOP_PORT=abc: Input should be a valid integer")


@pytest.mark.parametrize("fault", [KeyError("x"), FileNotFoundError(2, "No such file", "x"), ProgrammingError("select", {}, Exception())])
def test_a_fault_of_ours_is_not_put_in_other_words(fault: Exception) -> None:
    assert in_one_line(fault) is None
