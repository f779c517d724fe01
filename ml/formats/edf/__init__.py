"""EDF, EDF+ and BDF files: `CODE` is what the registry of formats takes of this package."""

from ml.formats.edf.facts import FACTS
from ml.formats.edf.head import begins_like_edf
from ml.formats.edf.read import decode_edf
from ml.formats.edf.redact import redact_edf
from ml.formats.registry import FormatCode

CODE = FormatCode(
    begins=begins_like_edf,
    within=lambda files, report: False,
    redact=redact_edf,
    decode=decode_edf,
    facts=FACTS,
)
