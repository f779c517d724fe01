"""HTML forms as API types: pages and the API share one set of rules. A form sends text, the API's types are strict.

Files of participants are encrypted before they touch the disk.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping
from contextlib import aclosing
from dataclasses import dataclass
from datetime import UTC, datetime
from types import NoneType, UnionType
from typing import Annotated, Any, TypeVar, Union, get_args, get_origin

from fastapi import Depends, Request
from pydantic import BaseModel, ValidationError
from starlette.datastructures import FormData, Headers, UploadFile
from starlette.exceptions import HTTPException
from starlette.formparsers import MultiPartException, MultiPartParser

from app.platform.errors import BetaloopError, Invalid
from app.platform.raw_bytes import raw_stream

M = TypeVar("M", bound=BaseModel)

_TRUE, _FALSE = {"yes", "true", "on", "1"}, {"no", "false", "off", "0", ""}


WRITTEN_BY = "written_by"
"""Name in the address that a form is sent to: the number of the user for whom its page was made (static/entries.js)."""


def written_by(request: Request) -> int | None:
    """Find who had signed in when a form was filled in, where its sender states it."""
    text = request.query_params.get(WRITTEN_BY, "")
    return int(text) if request.method == "POST" and text.isascii() and text.isdigit() and len(text) < 20 else None


async def _form(request: Request) -> FormData:
    return await request.form(max_files=0, max_fields=2000)


FormValues = Annotated[FormData, Depends(_form)]
"""The fields of a posted form (no files), e.g. `values.get("name", "")` and, for repeated ones, `values.getlist("policy")`."""


def same_value(one: str, other: str) -> bool:
    """Return whether two texts of a field state the same. Browsers send 10:00:00 as 10:00, and a line break as two characters."""
    one, other = (text.replace("\r\n", "\n").strip() for text in (one, other))
    if one == other:
        return True
    moments = [_moment(text) for text in (one, other)]
    return None not in moments and moments[0] == moments[1]


def _moment(text: str) -> datetime | None:
    """Parse a time with or without a date, UTC where it names no zone; None for other text."""
    if ":" not in text:
        return None
    try:
        found = datetime.fromisoformat(text if "-" in text else f"1970-01-01T{text}")
    except ValueError:
        return None
    return found if found.tzinfo else found.replace(tzinfo=UTC)


def parse(model: type[M], values: Mapping[str, Any], labels: Mapping[str, str] | None = None, names: Mapping[str, str] | None = None) -> M:
    """Read a model from form text. An empty field is null; a field that the form does not have is omitted.

    Args:
        model: the API type; only its fields are read.
        values: field name to text, or to a list of texts where the field is repeated.
        labels: names as the page shows them, for the errors.
        names: what the form calls the model's fields, where it calls them otherwise, for the errors.

    Raises:
        Invalid: names each field that is wrong and why; the document's `errors` holds them too, `name` being that of the field.
    """
    labels, names = labels or {}, names or {}
    errors: list[dict[str, str]] = []
    data: dict[str, Any] = {}
    for name, info in model.model_fields.items():
        if name in values:
            if isinstance(values[name], list):
                data[name] = values[name]
                continue
            try:
                data[name] = _value(str(values[name]), info.annotation, info.is_required())
            except ValueError as error:
                errors.append({"where": labels.get(name, name), "what": str(error), "name": names.get(name, name)})
    if not errors:
        try:
            return model.model_validate(data)
        except ValidationError as error:
            for e in (e for e in error.errors() if e["type"] != "default_factory_not_called"):  # follows from another field's error
                # a check of the model as a whole names its field by the error's type
                name = ".".join(map(str, e["loc"])) or (e["type"] if e["type"] in model.model_fields else "")
                errors.append({"where": labels.get(name, name), "what": _sentence(e), "name": names.get(name, name)})
    raise Invalid("Some fields cannot be used.", "Correct them and send the form again.", errors=errors)


def _sentence(error: Mapping[str, Any]) -> str:
    """Describe what is wrong with a field. A pattern is no sentence: the field's name or help says what it takes. An empty one needs a
    value."""
    if error["input"] is None:
        return "give a value"
    if error["type"] == "string_pattern_mismatch":
        return f"'{error['input']}' is not written as this field takes it"
    return str(error["msg"]).removeprefix("Value error, ")


@dataclass(frozen=True)
class FieldNote:
    """Note at a field of a refused form.

    Attributes:
        text: what is wrong, or what is asked.
        answer: of a question: the value of the box that says yes to what is typed now; empty for an error.
        confirmed: whether that box was ticked already.
    """

    text: str
    answer: str = ""
    confirmed: bool = False


def field_notes(
    error: BetaloopError | None, typed: Mapping[str, str], name_of: Callable[[Mapping[str, Any]], str] | None = None
) -> dict[str, FieldNote]:
    """Assign the parts of a refusal to the fields of its form.

    These are the problem's `errors` with a `name`, its `questions` with a `field`, and the whole of it where it names its own `field`. An
    error of one value of a list (`methods.1`) is shown at the list.

    Args:
        error: why the form was refused. typed: the text of its fields.
        name_of: the form's field that a question is about, where it is not called like the question's.
    """
    extra = error.extra if error else {}
    notes: dict[str, FieldNote] = {}
    for e in extra.get("errors", ()):
        if name := str(e.get("name", "")):
            notes.setdefault(name if name in typed else name.partition(".")[0], FieldNote(str(e["what"])))
    if error is not None and (named := str(extra.get("field", ""))):
        notes.setdefault(named, FieldNote(f"{error.detail} {error.hint}".strip()))
    for asked in extra.get("questions", ()):
        name = name_of(asked) if name_of else str(asked.get("field", ""))
        if name in typed:
            notes[name] = FieldNote(str(asked["text"]), _answer(name, typed[name]), bool(asked["confirmed"]))
    return notes


def renamed(error: BetaloopError, names: Mapping[str, str]) -> BetaloopError:
    """Rename the fields of an error as the form calls them; `names` maps the rule's name of a field to the form's."""
    if named := error.extra.get("field"):
        error.extra["field"] = names.get(named, named)
    error.extra |= (
        {"errors": [dict(e) | {"name": names.get(e["name"], e["name"])} if "name" in e else e for e in error.extra["errors"]]}
        if "errors" in error.extra
        else {}
    )
    return error


def confirmed(values: FormData, typed: Mapping[str, str]) -> list[str]:
    """List the fields of a form whose present text a person confirmed; a text that was changed after the question is asked about again."""
    given = {str(answer) for answer in values.getlist("sure")}
    return [name for name, text in typed.items() if _answer(name, text) in given]


def _answer(name: str, text: str) -> str:
    return f"{name}={text.strip()}"


_NO_DECIMALS = re.compile(r"(?<=\d)[.,]0{0,2}$")
"""Decimals that say nothing, as spreadsheets write them: 8.0, 8,00. Three zeros may be thousands, and are refused."""


def _value(text: str, annotation: Any, required: bool) -> Any:
    kinds = _kinds(annotation)
    text = text.strip()
    if bool in kinds:
        if text.lower() not in _TRUE | _FALSE:
            raise ValueError(f"'{text}' is neither yes nor no")
        return text.lower() in _TRUE
    if text == "":
        if NoneType in kinds or required:
            return None
        if str in kinds:
            return ""
        raise ValueError("give a value")
    if int in kinds:
        try:
            return int(_NO_DECIMALS.sub("", text))
        except ValueError:
            raise ValueError(f"'{text}' is no whole number") from None
    if float in kinds:
        try:
            return float(text.replace(",", ".") if text.count(",") == 1 and "." not in text else text)
        except ValueError:
            raise ValueError(f"'{text}' is no number") from None
    return text


def _kinds(annotation: Any) -> set[Any]:
    """Collect the plain types inside unions and `Annotated`."""
    origin = get_origin(annotation)
    if origin is Annotated:
        return _kinds(get_args(annotation)[0])
    if origin in (Union, UnionType):
        return {kind for part in get_args(annotation) for kind in _kinds(part)}
    return {annotation}


# Forms with files of participants: what comes is encrypted before it touches the disk.


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
