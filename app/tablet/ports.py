"""Check of a converted copy by `betaloop control check-port`: is it the policy of a bundle? No database, no service."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from app.platform.errors import Invalid
from app.tablet.command import verified
from ml.deploy.manifest import BundleError
from ml.deploy.ports.answers import AnswersError, write_answers
from ml.deploy.ports.check import NOT, check_port, port_vectors
from ml.deploy.ports.report import fault_words, headline, lines, page, page_pdf
from ml.deploy.ports.targets import RUNNABLE, TargetError, run_target


@dataclass(frozen=True)
class Outputs:
    """Files that a check writes, and what the copy is called on them; None writes none."""

    target: str | None = None
    page: Path | None = None
    answers: Path | None = None


def check(copy: Path, bundle: Path, key: str | None, outputs: Outputs) -> tuple[dict[str, Any], str, bool]:
    """Check a copy, or the table of its answers, against a bundle.

    Args:
        copy: CSV of answers, or what can be run here: `.onnx`, `.tflite`, or a shared library.
        bundle: the ZIP. key: as `verified` takes it. outputs: what else is written.

    Returns:
        The check for programs and for people, and whether the copy may be used.

    Raises:
        Invalid: bundle, copy or table cannot be used; says where and what to do.
    """
    opened = verified(bundle, key)
    target = outputs.target or copy.name
    try:
        content, given = bundle.read_bytes(), copy.read_bytes()
        vectors = port_vectors(content, opened.manifest)
        runs = copy.suffix in RUNNABLE
        table = write_answers(vectors, run_target(copy, vectors, opened.manifest)) if runs else given
        found = check_port(content, opened, table)
    except AnswersError as error:
        raise Invalid(f"{copy.name}, {error}.", error.hint) from error
    except TargetError as error:
        raise Invalid(f"{error}.", error.hint) from error
    except BundleError as error:
        raise Invalid(f"{bundle.name}: {error}.", "Take the bundle of the policy from the study.") from error
    except OSError as error:
        raise Invalid(f"{copy} cannot be read: {error.strerror}.", "Name a table of answers, or a copy that runs here.") from error
    if outputs.answers is not None:
        _write(outputs.answers, table)
    if outputs.page is not None:
        day = f"{date.today():%d %B %Y}"
        printed = page_pdf(found, target, day) if outputs.page.suffix.lower() == ".pdf" else page(found, target, day).encode()
        _write(outputs.page, printed)
    said = {"target": target, "headline": headline(found, target), "faults_in_words": [fault_words(f, found) for f in found.faults]}
    return said | found.to_json(), lines(found, target), found.verdict != NOT


def _write(path: Path, content: bytes) -> None:
    """Write a new file. Raises Invalid where it is there already or cannot be written."""
    try:
        with path.open("xb") as sink:
            sink.write(content)
    except OSError as error:
        raise Invalid(f"{path} cannot be written: {error.strerror}.", "Name a new file in a folder that may be written.") from error
