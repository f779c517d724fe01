"""Files of reports."""

from __future__ import annotations

import json

import pytest


@pytest.fixture
def write(tmp_path):
    def make(content, name="report.json"):
        path = tmp_path / name
        path.write_bytes(content if isinstance(content, bytes) else json.dumps(content).encode())
        return path

    return make
