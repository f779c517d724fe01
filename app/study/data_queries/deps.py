"""The data query that a path names, within what the caller may read."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends

from app.accounts.deps import CurrentCaller
from app.platform.database import Db
from app.platform.web.schemas import RowId
from app.study.data_queries import repository
from app.tables.data_queries import DataQuery


def current_query(query_id: RowId, db: Db, caller: CurrentCaller) -> DataQuery:
    """The query that the path names."""
    return repository.data_query(db, query_id, caller)


CurrentDataQuery = Annotated[DataQuery, Depends(current_query)]
