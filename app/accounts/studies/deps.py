"""FastAPI dependency: the study that a path names, of which the caller is an administrator."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends, Path

from app.accounts.deps import CurrentCaller
from app.accounts.studies import service
from app.platform.database import Db
from app.tables.accounts import Study


def managed_study(study_code: Annotated[str, Path(max_length=40, pattern=r"^[^\x00]*$")], db: Db, caller: CurrentCaller) -> Study:
    """Find the study. Raises NotFound, Forbidden."""
    return service.study_to_manage(db, study_code, caller)


ManagedStudy = Annotated[Study, Depends(managed_study)]
