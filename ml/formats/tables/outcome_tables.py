"""Kinds of tables that hold measurements of one outcome. A further kind is a module with its record, and its entry here."""

from __future__ import annotations

from collections.abc import Mapping

from ml.formats.tables.grasps import GRASP_TESTS
from ml.formats.tables.outcome_table import OutcomeTable
from ml.formats.tables.strivepd import WATCH_EXPORTS

OUTCOME_TABLES: tuple[OutcomeTable, ...] = (WATCH_EXPORTS, GRASP_TESTS)
"""In the order in which they are recognised."""

BY_KIND: Mapping[str, OutcomeTable] = {one.kind: one for one in OUTCOME_TABLES}
