"""Forms with files of participants: what comes is encrypted before it touches the disk."""

from __future__ import annotations

from contextlib import aclosing

from fastapi import Request
from starlette.datastructures import FormData, Headers, UploadFile
from starlette.exceptions import HTTPException
from starlette.formparsers import MultiPartException, MultiPartParser

from app.platform.raw_bytes import raw_stream


class _Parser(MultiPartParser):
    """Puts each file of a form into a raw stream, where the framework would put it into a temporary file as it is."""

    def on_headers_finished(self) -> None:
        super().on_headers_finished()
        plain = self._current_part.file
        if plain is None:
            return
        plain.file.close()  # empty as yet
        stream = raw_stream()
        self._files_to_close_on_error[-1] = stream  # type: ignore[call-overload]
        self._current_part.file = UploadFile(stream, size=0, filename=plain.filename, headers=Headers(raw=self._current_part.item_headers))


class EncryptedForm(Request):
    """A request whose form's files lie encrypted until they are closed."""

    async def _get_form(
        self, *, max_files: int | float = 1000, max_fields: int | float = 1000, max_part_size: int = 1024 * 1024
    ) -> FormData:
        if self._form is None and self.headers.get("Content-Type", "").lower().startswith("multipart/form-data"):
            async with aclosing(self.stream()) as stream:
                parser = _Parser(self.headers, stream, max_files=max_files, max_fields=max_fields, max_part_size=max_part_size)
                try:
                    self._form = await parser.parse()
                except MultiPartException as error:
                    raise HTTPException(400, error.message) from error
        return await super()._get_form(max_files=max_files, max_fields=max_fields, max_part_size=max_part_size)
