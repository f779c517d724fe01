#!/bin/sh
# s3fs 2026.9.0 with aiobotocore 3.9.1: retries of the two libraries multiply, and the setting that ends one leaves the other.
#
# A store that accepts connections and answers nothing is met when its network is cut or its disk hangs. The caller bounds the wait by
# botocore's timeouts and by `retries={"total_max_attempts": 1}`, which botocore documents as a single attempt. s3fs repeats the whole call
# five times all the same (class attribute `S3FileSystem.retries`), because a timeout is among the errors that it takes for passing.
# With three attempts of botocore, fifteen requests are sent. With the defaults of both (read timeout 60 s, five attempts each) one call of
# `info` may hold its caller for 25 minutes. `S3FileSystem.retries = 1` is what ends it.
#
# Prints the requests that a server saw for one call of `info`, and fails where they are others than were seen: 5, 15 and 1.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet --disable-pip-version-check s3fs==2026.9.0 aiobotocore==3.9.1
cat >"$folder/silent.py" <<'PYTHON'
import socket
import threading

import s3fs

TIMEOUT_S = 0.3


def requests_seen(attempts: int, repeats: int | None) -> int:
    """Count the requests that reach a server which never answers, during one call of `info`."""
    seen, held = [], []
    server = socket.create_server(("127.0.0.1", 0))

    def accept() -> None:
        while True:
            try:
                connection, _ = server.accept()
            except OSError:
                return
            held.append(connection)
            if connection.recv(65536):
                seen.append(1)

    threading.Thread(target=accept, daemon=True).start()
    config = {"read_timeout": TIMEOUT_S, "connect_timeout": TIMEOUT_S, "retries": {"total_max_attempts": attempts}}
    store = s3fs.S3FileSystem(
        key="key", secret="secret", endpoint_url=f"http://127.0.0.1:{server.getsockname()[1]}", config_kwargs=config, skip_instance_cache=True
    )
    if repeats is not None:
        store.retries = repeats
    try:
        store.info("recordings/session.zip")
    except Exception as error:
        print(f"  ended with {type(error).__name__}")
    server.close()
    return len(seen)


found = [requests_seen(1, None), requests_seen(3, None), requests_seen(1, 1)]
print(f"s3fs {s3fs.__version__}: requests with botocore's attempts 1, 3, and 1 with S3FileSystem.retries = 1: {found}")
raise SystemExit(found != [5, 15, 1])
PYTHON
"$folder/venv/bin/python" "$folder/silent.py"
