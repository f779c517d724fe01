"""What somebody asks of the audit trail."""

from __future__ import annotations

import datetime as dt
from dataclasses import dataclass

from pydantic import Field, model_validator
from pydantic_core import PydanticCustomError

from app.platform.web.schemas import Model, Text

ACTION_WORDS = {
    "insert": "added wrote down stored", "update": "changed corrected", "delete": "removed", "view": "looked viewed",
    "export": "exported took", "download": "printed downloaded", "refuse": "refused",
}  # fmt: skip
"""What sentences say of an action; a search finds rows by these words too."""
SHOWN_NAMES = {
    "qoc": "outcomes", "buffer_snapshot": "snapshot", "buffer_gate_decision": "learning from tested policies", "app_user": "account",
    "api_token": "token", "session_proposal": "proposed session", "job": "job",
}  # fmt: skip
"""Tables that pages call otherwise than the database."""


@dataclass(frozen=True)
class Kind:
    """Acts that somebody looks for together: by their action, or as a new row of a table."""

    said: str
    actions: tuple[str, ...] = ()
    tables: tuple[str, ...] = ()


KINDS = {
    "changes": Kind("changes of rows", ("insert", "update", "delete")),
    "removals": Kind("removals", ("delete",)),
    "views": Kind("looks at results", ("view",)),
    "exports": Kind("exports, prints and bundles", ("export", "download"), ("bundle_release",)),
    "refusals": Kind("refused sign-ins", ("refuse",)),
    "signatures": Kind("signatures", (), ("signature",)),
}


class TrailFilter(Model):
    """What is looked for; what is left empty matches all."""

    words: Text = Field("", max_length=200, description="Each must stand in the sentence or in a value.")
    participant: Text = Field("", max_length=40, description="Code.")
    action: Text = Field("", max_length=20)
    entity: Text = Field("", max_length=63)
    entity_id: Text = Field("", max_length=200)
    actor: Text = Field("", max_length=254)
    begin: dt.date | None = Field(None, description="First day, UTC.")
    end: dt.date | None = Field(None, description="Last day, UTC.")

    @model_validator(mode="after")
    def _known(self) -> TrailFilter:
        if self.action and self.action not in KINDS:
            raise PydanticCustomError("kind", "there is no such kind of act")
        if self.begin and self.end and self.end < self.begin:
            raise PydanticCustomError("days", "the last day is before the first")
        if len(self.words.split()) > MOST_WORDS:
            raise PydanticCustomError("words", "too many words to look for at once")
        return self

    def stated(self) -> dict[str, str]:
        """What is not left empty, by name."""
        return {name: str(value) for name, value in self.model_dump().items() if value not in ("", None)}


MOST_WORDS = 8
"""Each word is a look through the whole trail."""
