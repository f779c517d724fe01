"""Finished cells of a benchmark, so that a run that is started again skips them."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any


class Cells:
    """Finished cells, one JSON object per line, by their key."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._cells: dict[str, Any] = {}
        for line in path.read_text().splitlines() if path.exists() else []:
            # A line that an interrupted run cut short is no cell.
            if line.endswith("}"):
                cell = json.loads(line)
                self._cells[cell["key"]] = cell

    def get(self, key: str) -> Any:
        return self._cells.get(key)

    def add(self, key: str, **content: Any) -> dict[str, Any]:
        cell = {"key": key, **content}
        self._cells[key] = cell
        with self._path.open("a") as file:
            file.write(json.dumps(cell) + "\n")
        return cell

    def all(self, prefix: str) -> list[dict[str, Any]]:
        return [cell for key, cell in self._cells.items() if key.startswith(prefix)]
