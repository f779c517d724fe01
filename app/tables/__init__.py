"""Every table of the database, one file per aggregate, and the enumerations of their columns.

Importing one loads all, so that the metadata are complete and foreign keys resolve. Tables use `app.platform.database` and `ml` alone;
everything else may use them.
"""

from __future__ import annotations

from importlib import import_module
from pkgutil import iter_modules

from app.platform.database import Base

METADATA = Base.metadata

for _module in iter_modules(__path__, f"{__name__}."):
    import_module(_module.name)
