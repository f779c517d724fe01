"""Large scripts are sent compressed to those who take it."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import plotly
import pytest
from fastapi import FastAPI
from fastapi.testclient import TestClient

from app.platform.web.compression import CompressedFiles
from app.settings import get_settings

ORIGINAL = Path(plotly.__file__).parent / "package_data" / "plotly.min.js"


@pytest.fixture
def client(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[TestClient]:
    """A service with the chart library, and a data folder of its own."""
    monkeypatch.setenv("BETALOOP_DATA_DIR", str(tmp_path))
    get_settings.cache_clear()
    app = FastAPI()
    app.mount("/plotly", CompressedFiles(packages=[("plotly", "package_data")]))
    yield TestClient(app)
    get_settings.cache_clear()


def test_the_chart_library_arrives_whole_and_a_third_as_large(client: TestClient) -> None:
    plain = client.get("/plotly/plotly.min.js", headers={"Accept-Encoding": "identity"})
    packed = client.get("/plotly/plotly.min.js", headers={"Accept-Encoding": "gzip, br"})
    assert "content-encoding" not in plain.headers
    assert packed.headers["content-encoding"] == "gzip"
    assert packed.headers["content-type"].startswith("text/javascript")
    assert packed.headers["vary"] == "Accept-Encoding"
    assert packed.content == plain.content == ORIGINAL.read_bytes()
    assert int(packed.headers["content-length"]) < len(plain.content) / 3


def test_who_refuses_gzip_gets_the_file_itself(client: TestClient) -> None:
    answer = client.get("/plotly/plotly.min.js", headers={"Accept-Encoding": "gzip;q=0"})
    assert "content-encoding" not in answer.headers


def test_the_browser_keeps_it(client: TestClient) -> None:
    first = client.get("/plotly/plotly.min.js")
    assert "immutable" in first.headers["cache-control"]
    assert client.get("/plotly/plotly.min.js", headers={"If-None-Match": first.headers["etag"]}).status_code == 304
