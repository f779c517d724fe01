"""Tables that no decoder knows, read by a column mapping that a person stated: preview, mapping, stored form."""

from ml.formats.tables.mapping.apply import find_mapping, redact_mapped
from ml.formats.tables.mapping.model import MappedColumn, TableMapping
from ml.formats.tables.mapping.preview import preview_of
from ml.formats.tables.mapping.stored import decode_mapped

__all__ = ["MappedColumn", "TableMapping", "decode_mapped", "find_mapping", "preview_of", "redact_mapped"]
