"""Several web services on one database: a browser may be sent to any of them at any request."""

from __future__ import annotations

import httpx2 as httpx
import pytest

from benchmarks.installed.installation import PASSWORD, STARTED_S, installation


@pytest.mark.slow
@pytest.mark.timeout(300)
def test_who_signs_in_at_one_web_is_signed_in_and_out_at_the_other() -> None:
    with installation(webs=2) as installed:
        installed.add_people({"ada@clinic.example": "admin"})
        for web in installed.webs:
            installed.start(web)
        installed.wait_until("the first answer of every web", installed.webs_are_ready, STARTED_S)
        one, other = installed.bases
        headers = {"Accept": "text/html", "Sec-Fetch-Site": "same-origin"}
        with httpx.Client(headers=headers, timeout=STARTED_S) as browser:
            assert browser.get(f"{other}/").headers["location"].startswith("/sign-in")
            answer = browser.post(f"{one}/sign-in", data={"email": "ada@clinic.example", "password": PASSWORD})
            assert answer.status_code == 303
            assert [browser.get(f"{web}/").status_code for web in (one, other)] == [200, 200]
            assert browser.post(f"{other}/sign-out").status_code == 303
            assert browser.get(f"{one}/").headers["location"].startswith("/sign-in")
