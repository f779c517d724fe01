"""The bytes of a policy file that arrives by form or REST."""

from __future__ import annotations

from fastapi import UploadFile

from app.learning.policies import service
from app.platform.errors import TooLarge


def read_limited(file: UploadFile) -> bytes:
    """Read the bytes of an uploaded policy. Raises TooLarge."""
    content = file.file.read(service.UPLOAD_LIMIT + 1)
    if len(content) > service.UPLOAD_LIMIT:
        raise TooLarge(
            f"'{file.filename}' is larger than {service.UPLOAD_LIMIT >> 20} MiB.",
            "A policy of the study's kind has some kilobytes.",
            field="file",
        )
    return content
