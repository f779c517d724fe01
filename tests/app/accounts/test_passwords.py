"""Passwords that anybody would try first are refused; long ones of unrelated words are not."""

from __future__ import annotations

import subprocess
import sys

import pytest

from app.accounts.passwords import weakness


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
    ],
)
def test_what_is_guessed_first_is_refused(password: str) -> None:
    assert weakness(password, "ada.lovelace@clinic.example") is not None


@pytest.mark.parametrize(
    "password",
    ["correct horse battery", "a password of the test", "long enough here", "vK9-tuL2-qqRw", "Grünkohl im Regen", "überquert 7 Brücken"],
)
def test_what_is_not_is_taken(password: str) -> None:
    assert weakness(password, "ada@clinic.example") is None


@pytest.mark.parametrize("password", ["83#05!71%62", "x7#9k!2w@5"])
def test_few_letters_are_refused_for_what_they_are(password: str) -> None:
    assert weakness(password) == "has fewer than 4 letters that belong neither to a common word nor to the e-mail address"


def test_passwords_are_stored_at_the_cost_that_owasp_recommends() -> None:
    # in a process of its own: the tests' own passwords are cheaper
    code = "from app.accounts import service; print(service._hasher.hash('correct horse battery'))"
    stored = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert stored.startswith("$argon2id$v=19$m=19456,t=2,p=1$")
