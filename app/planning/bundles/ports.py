"""Rules of checks of ports: answers of a converted copy to a bundle's vectors, compared by the service alone. The caller commits."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from sqlalchemy.orm import Session

from app.accounts import permissions as can
from app.accounts.permissions import Caller
from app.learning import foreign
from app.learning.policies import FOREIGN
from app.planning.bundles import repository
from app.platform import files
from app.platform.database import end_reading
from app.platform.errors import Conflict, Invalid, NotFound, TooLarge
from app.study import access
from app.tables.learning import Policy
from app.tables.participants import Participant
from app.tables.plans import PortCheck as PortCheckRow
from ml.deploy.bundle import unpack
from ml.deploy.ports.answers import MAX_BYTES, AnswersError
from ml.deploy.ports.check import PortCheck, check_file
from ml.deploy.ports.report import headline
from ml.deploy.ports.vectors import PORT_VECTORS

CHECK = "app.planning.bundles.compute:check_port"
"""Function that a child runs."""
HASH = 12
"""Characters of a hash that a sheet prints."""


def add_check(
    db: Session, participant: Participant, policy: Policy, table: bytes, target: str, bundle_sha256: str | None, caller: Caller
) -> PortCheckRow:
    """Check the answers of a copy and keep them with the result.

    Args:
        table: CSV as `ml.deploy.ports.answers.read_answers` takes it. target: what was converted, by what.
        bundle_sha256: of the bundle that was answered; the newest one with port vectors when None.

    Raises:
        Forbidden: the caller may not take bundles. Conflict: no bundle of the policy with port vectors was taken.
        Invalid: the table cannot be used, or no target is named. NotFound: no such bundle of this policy.
    """
    access.require(caller, can.TAKE_BUNDLES, participant)
    access.require_own(participant, policy, f"policy {policy.id}")
    if not target.strip():
        raise Invalid("The check needs a name of the copy.", "Say what was converted, by what: 'TFLite, onnx2tf 1.29.24'.", field="target")
    if len(table) > MAX_BYTES:
        raise TooLarge("The table of answers is too large.", "Send the rows of the port vectors alone.", field="file")
    sha256, content = _bundle_of(db, policy, bundle_sha256)
    found = _check(policy, content, table)
    end_reading(db)
    row = PortCheckRow(
        policy_id=policy.id,
        bundle_sha256=sha256,
        answers_sha256=files.store(db, table).sha256,
        target=target.strip(),
        verdict=found.verdict,
        result=found.to_json(),
        created_by=caller.label,
    )
    db.add(row)
    db.flush()
    return row


def _bundle_of(db: Session, policy: Policy, sha256: str | None) -> tuple[str, bytes]:
    """Find the bundle that was answered, with its bytes. Raises Conflict, NotFound."""
    taken = list(dict.fromkeys(row.sha256 for row in repository.releases(db, policy.id)))
    if sha256 is not None and sha256 not in taken:
        raise NotFound(f"No bundle {sha256[:HASH]} of policy '{policy.name}' was taken.", "Name the SHA-256 of one that was.")
    for digest in taken if sha256 is None else [sha256]:
        content = files.read(digest)
        if PORT_VECTORS in unpack(content):
            return digest, content
    raise Conflict(
        f"No bundle of policy '{policy.name}' with {PORT_VECTORS} was taken.", "Take the bundle, and run the copy on the vectors in it."
    )


def _check(policy: Policy, content: bytes, table: bytes) -> PortCheck:
    """Check answers; a policy made elsewhere runs in a child. Raises Invalid, with the line at fault."""
    if policy.kind != FOREIGN:
        try:
            return check_file(content, table)
        except AnswersError as error:
            raise _unusable(str(error), error.hint) from error
    with files.draft_folder() as folder:
        paths = {name: folder / name for name in ("bundle", "answers")}
        for name, given in (("bundle", content), ("answers", table)):
            paths[name].write_bytes(given)
        found = foreign.run(CHECK, {name: str(path) for name, path in paths.items()})
    if "refused" in found:
        raise _unusable(found["refused"], found["hint"])
    return PortCheck.from_json(found["check"])


def _unusable(what: str, hint: str) -> Invalid:
    return Invalid(f"The answers cannot be used: {what}.", hint, field="file")


def checks_of(db: Session, policy: Policy) -> list[tuple[PortCheckRow, PortCheck]]:
    """List the checks of a policy's ports, newest first, each with its result."""
    return [(row, result_of(row)) for row in repository.port_checks(db, [policy.id])]


def find_check(db: Session, policy: Policy, check_id: int) -> PortCheckRow:
    """Find a check of this policy. Raises NotFound."""
    row = db.get(PortCheckRow, check_id)
    if row is None or row.policy_id != policy.id:
        raise NotFound(f"There is no check {check_id} of a port of policy '{policy.name}'.")
    return row


def result_of(row: PortCheckRow) -> PortCheck:
    """Read the result of a check."""
    return PortCheck.from_json(row.result)


def line_of(row: PortCheckRow) -> str:
    """Write a check in one line: day, copy, most serious fault, verdict."""
    return headline(result_of(row), f"port of {row.created_at:%d %b %Y}, {row.target}")


def lines_of(db: Session, policy_ids: Sequence[int]) -> Mapping[int, str]:
    """Write the newest check of each copy for the sheets, by the number of the policy, with the hash of its answers."""
    newest: dict[tuple[int, str], PortCheckRow] = {}
    for row in repository.port_checks(db, policy_ids):
        newest.setdefault((row.policy_id, row.target), row)
    found: dict[int, list[str]] = {}
    for row in newest.values():
        found.setdefault(row.policy_id, []).append(f"{line_of(row)} (answers {row.answers_sha256[:HASH]})")
    return {policy_id: "; ".join(texts) for policy_id, texts in found.items()}
