"""The dose that a path names, within what the caller may read."""

from __future__ import annotations

from typing import Annotated

from fastapi import Depends

from app.accounts.deps import CurrentCaller
from app.platform.database import Db
from app.platform.web.schemas import RowId
from app.study.doses import repository
from app.tables.visits import Dose, Visit


def current_dose(dose_id: RowId, db: Db, caller: CurrentCaller) -> tuple[Dose, Visit]:
    """The dose that the path names, and its visit."""
    return repository.dose_with_visit(db, dose_id, caller)


CurrentDose = Annotated[tuple[Dose, Visit], Depends(current_dose)]
