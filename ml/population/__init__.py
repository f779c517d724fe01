"""Four synthetic participants whose true responses are known. They are not fitted to patients.

Names that need compiled code are loaded when first used, so that importing this package is cheap.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from ml.population.participants import PARTICIPANTS, ParticipantModel

if TYPE_CHECKING:
    from ml.population.clinic import plan_day, random_controller_buffer, run_day
    from ml.population.device.folder import rcs_session_zip
    from ml.population.sessions import SessionBatch, SimulatedSession, run_session, run_sessions, session_table_csv
    from ml.population.truth import TrueReturn, true_return

_LAZY = {
    "plan_day": "clinic",
    "random_controller_buffer": "clinic",
    "run_day": "clinic",
    "rcs_session_zip": "device.folder",
    "SessionBatch": "sessions",
    "SimulatedSession": "sessions",
    "run_session": "sessions",
    "run_sessions": "sessions",
    "session_table_csv": "sessions",
    "TrueReturn": "truth",
    "true_return": "truth",
}

__all__ = [
    "PARTICIPANTS",
    "ParticipantModel",
    "SessionBatch",
    "SimulatedSession",
    "TrueReturn",
    "plan_day",
    "random_controller_buffer",
    "rcs_session_zip",
    "run_day",
    "run_session",
    "run_sessions",
    "session_table_csv",
    "true_return",
]


def __getattr__(name: str) -> Any:
    if name not in _LAZY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    value = getattr(import_module(f"ml.population.{_LAZY[name]}"), name)
    globals()[name] = value
    return value
