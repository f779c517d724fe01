"""XDF files of the Lab Streaming Layer: `CODE` is what the registry of formats takes of this package."""

from ml.formats.registry import FormatCode
from ml.formats.xdf.chunks import MAGIC
from ml.formats.xdf.facts import FACTS
from ml.formats.xdf.read import decode_xdf
from ml.formats.xdf.redact import redact_xdf

CODE = FormatCode(
    begins=lambda head: head.startswith(MAGIC),
    within=lambda files, report: False,
    redact=redact_xdf,
    decode=decode_xdf,
    facts=FACTS,
)
