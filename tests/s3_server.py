"""An S3 server in a process of its own."""

from __future__ import annotations

import socket
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

from botocore.session import Session as Aws

from tests.ports import free_port

NAME = "clinic"
CREDENTIALS = {"AWS_ACCESS_KEY_ID": "testing", "AWS_SECRET_ACCESS_KEY": "testing", "AWS_DEFAULT_REGION": "us-east-1"}


class Server:
    """An S3 server in a process of its own, and what it holds as any other client sees it."""

    def __init__(self) -> None:
        self.port = free_port()
        self.address = f"http://127.0.0.1:{self.port}"
        self.start()
        self.s3 = Aws().create_client("s3", region_name="us-east-1", endpoint_url=self.address)
        self.s3.create_bucket(Bucket=NAME)

    def start(self) -> None:
        call = [str(Path(sys.executable).with_name("moto_server")), "-H", "127.0.0.1", "-p", str(self.port)]
        self.process = subprocess.Popen(call, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
        for _ in range(600):
            with suppress(OSError), socket.create_connection(("127.0.0.1", self.port), 1):
                return
            time.sleep(0.1)
        raise AssertionError("the S3 server does not start")

    def stop(self) -> None:
        self.process.kill()
        self.process.wait()

    def objects(self, prefix: str = "") -> dict[str, bytes]:
        listed = self.s3.list_objects_v2(Bucket=NAME, Prefix=prefix).get("Contents", [])
        return {o["Key"]: self.s3.get_object(Bucket=NAME, Key=o["Key"])["Body"].read() for o in listed}
