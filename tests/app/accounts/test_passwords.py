"""Passwords that anybody would try first are refused; long ones of unrelated words are not."""

from __future__ import annotations

import subprocess
import sys
import time
from concurrent.futures import ThreadPoolExecutor

import pytest

from app.accounts import service
from app.accounts.passwords import weakness
from app.platform.errors import Invalid


@pytest.mark.parametrize(
    "password",
    [
        "short",
        "password123",
        "Passw0rd2026!",
        "P@$$w0rd!!!",
        "1234567890",
        "0987654321!",
        "qwertyuiop",
        "Qwertz123456",
        "aaaaaaaaaaaa",
        "abababababab",
        "abcdefghijkl",
        "Welcome2026!",
        "betaloop-admin",
        "Hospital#2026",
        "ada.lovelace1",
        "Clinic!Admin1",
        "letmein-12345",
        "!!!!!!!!!!!!",
        "parkinson2026",
        "basketball",
        "christopher",
        "manchester",
        "1q2w3e4r5t",
        "1qaz2wsx3edc",
        "qazwsxedcrfv",
        "chocolate1",
        "liverpool1",
        "michael1234",
        "Ch0c0late!23",
        "Manchester1999",
        "christopher1985",
        "sunflower2025!",
        "14.03.1987ab",
        "adalovelace1815",
        "king.noel-Ada",
    ],
)
def test_what_is_guessed_first_is_refused(password: str) -> None:
    assert weakness(password, "ada.lovelace@clinic.example", "Ada King-Noel") is not None


@pytest.mark.parametrize(
    "password",
    [
        "correct horse battery",
        "a password of the test",
        "long enough here",
        "vK9-tuL2-qqRw",
        "Grünkohl im Regen",
        "überquert 7 Brücken",
        "quiet lamps gather rain " * 20,
        "kJ8qWz2LmP",
    ],
)
def test_what_is_not_is_taken(password: str) -> None:
    assert weakness(password, "ada@clinic.example") is None


@pytest.mark.parametrize("password", ["83#05!71%62", "x7#9k!2w@5"])
def test_few_letters_are_refused_for_what_they_are(password: str) -> None:
    assert weakness(password) == "has fewer than 4 letters that belong neither to a common word nor to the e-mail address or name"


def test_what_others_know_of_somebody_is_no_secret() -> None:
    password = "quillfeather-zandvoort"
    assert weakness(password) is None
    assert weakness(password, "q.zandvoort@quillfeather.example") is not None
    assert weakness(password, "", "Quillfeather Zandvoort") is not None


def test_many_judged_at_once_are_each_judged_by_their_own_words() -> None:
    """The package keeps the words of its caller in one place."""
    people = [("zandvoort", "quillfeather"), ("bramblewick", "osterhagen")] * 20
    with ThreadPoolExecutor(8) as threads:
        found = list(threads.map(lambda p: weakness(f"{p[0]}-{p[1]}-q7", "", " ".join(p)), people))
        others = list(threads.map(lambda p: weakness(f"{p[0]}-{p[1]}-q7", "", "Ada Lovelace"), people))
    assert None not in found
    assert set(others) == {None}


def test_what_is_refused_is_told_with_its_reason_and_what_to_do() -> None:
    with pytest.raises(Invalid) as refused:
        service.check_password("basketball", "ada@clinic.example")
    said = (
        "The password is one of those that are guessed first: a common password, word, name, date or way over the keyboard, or little more."
    )
    assert refused.value.detail == said
    assert refused.value.hint == "Use at least 10 characters, such as four words that have nothing to do with each other."


def test_no_password_takes_long_to_judge() -> None:
    for hard in ("a4@8({[<369|!1|7$5+%2" * 3000, "18736@9(9%{7!58980$[6%4+4<<128%|" * 2):
        begun = time.process_time()
        weakness(hard)
        assert time.process_time() - begun < 4


def test_passwords_are_stored_at_the_cost_that_owasp_recommends() -> None:
    # in a process of its own: the tests' own passwords are cheaper
    code = "from app.accounts import service; print(service._hasher.hash('correct horse battery'))"
    stored = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert stored.startswith("$argon2id$v=19$m=19456,t=2,p=1$")
