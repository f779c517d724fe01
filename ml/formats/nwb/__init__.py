"""NWB 2 files: `CODE` is what the registry of formats takes of this package."""

from ml.formats.nwb.facts import FACTS
from ml.formats.nwb.file import SIGNATURE
from ml.formats.nwb.read import decode_nwb
from ml.formats.nwb.redact import redact_nwb
from ml.formats.registry import FormatCode

CODE = FormatCode(
    begins=lambda head: head.startswith(SIGNATURE),
    within=lambda files, report: False,
    redact=redact_nwb,
    decode=decode_nwb,
    facts=FACTS,
)
