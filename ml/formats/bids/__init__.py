"""BIDS folders of recordings within the brain (iEEG), zipped: `CODE` is what the registry of formats takes of this package."""

from ml.formats.bids.facts import FACTS
from ml.formats.bids.folder import holds_folder
from ml.formats.bids.read import decode_bids
from ml.formats.bids.redact import redact_bids
from ml.formats.registry import FormatCode

CODE = FormatCode(
    begins=lambda head: False,
    within=holds_folder,
    redact=redact_bids,
    decode=decode_bids,
    facts=FACTS,
)
