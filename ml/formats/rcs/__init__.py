"""Summit RC+S session folders: `CODE` is what the registry of formats takes of this package."""

from ml.formats.rcs.folder import LOOSE, decode_rcs, holds_session
from ml.formats.rcs.packets.example import write_example
from ml.formats.rcs.packets.facts import FACTS
from ml.formats.rcs.redact import redact_rcs_zip
from ml.formats.registry import FormatCode

CODE = FormatCode(
    begins=lambda head: False,
    within=holds_session,
    redact=redact_rcs_zip,
    decode=decode_rcs,
    facts=FACTS,
    example=write_example,
    loose=LOOSE,
)
