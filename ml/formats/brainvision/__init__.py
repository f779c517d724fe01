"""BrainVision recordings of three files: `CODE` is what the registry of formats takes of this package."""

from ml.formats.brainvision.facts import FACTS
from ml.formats.brainvision.files import LOOSE, holds_recording
from ml.formats.brainvision.read import decode_brainvision
from ml.formats.brainvision.redact import redact_brainvision
from ml.formats.registry import FormatCode

CODE = FormatCode(
    begins=lambda head: False,
    within=holds_recording,
    redact=redact_brainvision,
    decode=decode_brainvision,
    facts=FACTS,
    loose=LOOSE,
)
