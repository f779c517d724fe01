"""Doses are entered on the clinic day."""

from __future__ import annotations

from alembic import op

revision = "0029"
down_revision = "0027"
branch_labels = None
depends_on = None

KINDS = (
    "start", "stop", "stop_cause", "rating", "grasp", "dyskinesia", "speech", "gait", "note", "adverse_event", "skip", "repeat",
    "session_end", "clinical_settings",
)  # fmt: skip
OF_THE_DAY = ("note", "adverse_event", "clinical_settings")
DOSE = ("dose",)


def _listed(words: tuple[str, ...]) -> str:
    return ", ".join(f"'{word}'" for word in words)


def _allow(kinds: tuple[str, ...], of_the_day: tuple[str, ...]) -> None:
    checks = {"kind": f"kind in ({_listed(kinds)})", "session": f"plan_item_id is not null or kind in ({_listed(of_the_day)})"}
    for name, check in checks.items():
        op.drop_constraint(op.f(f"ck_day_entry_{name}"), "day_entry", type_="check")
        op.create_check_constraint(op.f(f"ck_day_entry_{name}"), "day_entry", check)


def upgrade() -> None:
    _allow(KINDS + DOSE, OF_THE_DAY + DOSE)


def downgrade() -> None:
    # entries are never deleted: where doses were entered this is refused, and the data stay whole
    _allow(KINDS, OF_THE_DAY)
