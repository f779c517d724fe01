"""Summit RC+S session folders: read by `decode_rcs`, freed of identity by `redact_rcs_zip`; `find_sessions` lists those of an archive."""

from ml.formats.rcs.folder import decode_rcs, find_sessions
from ml.formats.rcs.redact import redact_rcs_zip

__all__ = ["decode_rcs", "find_sessions", "redact_rcs_zip"]
