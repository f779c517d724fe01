"""Names of the rows that the audit trail tells of, by their numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any

Row = Mapping[str, Any]


@dataclass(frozen=True)
class Names:
    """Names of the rows that changes are about, by their numbers.

    Attributes:
        participants: code. visits: number and participant. sessions: ordinal and visit. plans: visit. policies: name and participant.
        items: position and plan. events: participant and visit. queries: participant and what is asked about, in words. locks: visit.
        margins_locks: participant. people: address. studies: code. sites: code. sweeps: name and participant. snapshots: participant.
    """

    participants: Mapping[int, str] = field(default_factory=dict)
    visits: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    sessions: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    plans: Mapping[int, int] = field(default_factory=dict)
    policies: Mapping[int, tuple[str, int]] = field(default_factory=dict)
    items: Mapping[int, tuple[int, int]] = field(default_factory=dict)
    events: Mapping[int, tuple[int, int | None]] = field(default_factory=dict)
    queries: Mapping[int, Row] = field(default_factory=dict)
    locks: Mapping[int, int] = field(default_factory=dict)
    margins_locks: Mapping[int, int] = field(default_factory=dict)
    people: Mapping[int, str] = field(default_factory=dict)
    studies: Mapping[int, str] = field(default_factory=dict)
    sites: Mapping[int, str] = field(default_factory=dict)
    sweeps: Mapping[int, tuple[str, int]] = field(default_factory=dict)
    snapshots: Mapping[int, int] = field(default_factory=dict)

    def participant(self, number: int | None) -> str:
        """Its code."""
        return self.participants.get(number or 0, f"participant {number}")

    def visit(self, number: int | None) -> str:
        """A visit with its participant."""
        if number is None or number not in self.visits:
            return f"a visit that is gone ({number})"
        ordinal, participant = self.visits[number]
        return f"visit {ordinal} of {self.participant(participant)}"

    def session(self, number: int | None, row: Row | None = None) -> str:
        """A session with its visit; `row` where the session may be gone."""
        place = self.sessions.get(number or 0) or ((row["ordinal"], row["visit_id"]) if row and "visit_id" in row else None)
        return f"session {place[0]} of {self.visit(place[1])}" if place else f"session {number}"

    def policy(self, number: int) -> str:
        """A policy with its participant."""
        name, participant = self.policies.get(number, (f"policy {number}", None))
        return f"policy {name} of {self.participant(participant)}" if participant is not None else name

    def plan(self, number: int) -> str:
        """A plan with its visit."""
        visit = self.plans.get(number)
        return f"plan {number}" + (f" for {self.visit(visit)}" if visit is not None else "")

    def slot(self, number: int | None, plan: int) -> str:
        """A planned session with its plan; the plan alone where none is named."""
        item = self.items.get(number or 0)
        return f"session {item[0]} of {self.plan(item[1])}" if item else self.plan(plan)

    def event(self, number: int) -> str:
        """Whose adverse event, and at which visit."""
        participant, visit = self.events.get(number, (None, None))
        return self.at(participant, visit)

    def at(self, participant: int | None, visit: int | None) -> str:
        """A participant, at a visit where one is named."""
        known = self.visits.get(visit or 0)
        return self.participant(participant) + (f" at visit {known[0]}" if known else "")

    def sweep(self, number: int) -> str:
        """A sweep with its participant."""
        name, participant = self.sweeps.get(number, (f"sweep {number}", None))
        return f"{name} of {self.participant(participant)}" if participant is not None else name

    def person(self, number: int | None) -> str:
        """Somebody's address."""
        return self.people.get(number or 0, f"account {number}")

    def place(self, study: int | None, site: int | None) -> str:
        """A study, and a site of it where one is named."""
        which = f"study {self.studies.get(study or 0, study)}"
        return which if site is None else f"{which}, site {self.sites.get(site, site)}"
