"""Every page that the service has answers, is small over the wire, and a reader of results meets no word of the methods."""

from __future__ import annotations

import json
import re
import zlib
from pathlib import Path

from fastapi.testclient import TestClient

from app.settings import get_settings
from tests.app.every_route import PASSWORD, World
from tests.app.pages.every_page import ELSEWHERE, addresses, ended_jobs, routes
from tests.app.words import above_fold, drawn, drawn_above_fold, methods_named, miscounted, said_by_script

MOST_BYTES = 60_000
INLINE = re.compile(r'<script(?![^>]*(?:src=|application/json))[^>]*>|\son\w+="|javascript:|(?:src|action)="(?:https?:)?//')
"""Scripts that are in a page itself, and what it would load from, or send to, elsewhere."""
METHODS_EXPLAINED = {"/glossary": "says what the words of the folds mean"}
"""Pages that are about these words."""
WITHOUT_A_READER = {"/sign-in", "/visit-day/shell"}
"""Pages that are shown without a user."""
OF_NO_PARTICIPANT = {
    "/", "/account", "/accounts", "/adverse-events", "/api-reference", "/audit", "/glossary", "/jobs", "/participants/new", "/search",
    "/studies", "/studies/{study_code}/column-mappings", "/visit-day/shell",
}  # fmt: skip
"""Pages about no participant, or about several participants, whose rows say which are synthetic."""
STATIC = Path(__file__).resolve().parents[3] / "static"


def test_every_address_of_a_browser_answers_and_every_page_is_small(world: World) -> None:
    assert set(ELSEWHERE) <= set(routes(world.app))
    reader = TestClient(world.app, headers={"Accept": "text/html", "Accept-Encoding": "gzip"}, follow_redirects=False)
    assert reader.post("/sign-in", data={"email": "admin@clinic.example", "password": PASSWORD}).status_code == 303
    refused, large, inline, pages = {}, {}, {}, 0
    get_settings().development = True
    for route, path in addresses(world).items():
        with reader.stream("get", path) as answer:
            if answer.status_code not in (200, 303):
                refused[route] = answer.status_code
            if not answer.headers.get("content-type", "").startswith("text/html"):
                continue
            sent = b"".join(answer.iter_raw())
        pages += 1
        assert answer.headers["content-encoding"] == "gzip", route
        text = zlib.decompress(sent, 31).decode()
        assert text.rstrip().endswith("</html>"), route
        inline |= {route: found} if (found := INLINE.findall(text)) else {}
        if len(sent) > MOST_BYTES:
            large[route] = len(sent)
    assert refused == {}, "give the page a row to show in every_page.py"
    assert large == {}
    assert inline == {}, "scripts stand in files of our own, which the policy of the page's content allows alone"
    assert pages >= 50


def test_every_page_and_file_about_synthetic_participants_says_so(world: World) -> None:
    reader = TestClient(world.app, headers={"Accept": "text/html"}, follow_redirects=False)
    assert reader.post("/sign-in", data={"email": "admin@clinic.example", "password": PASSWORD}).status_code == 303
    silent, files = set(), []
    for route, path in addresses(world).items():
        with reader.stream("get", path) as answer:
            if answer.status_code != 200:
                continue
            if "filename=" in answer.headers.get("content-disposition", ""):
                files.append((route, answer.headers["content-disposition"]))
            elif answer.headers["content-type"].startswith("text/html") and 'id="synthetic"' not in answer.read().decode():
                silent.add(route)
    assert silent == OF_NO_PARTICIPANT
    assert len(files) >= 8
    assert [route for route, name in files if 'filename="synthetic-' not in name] == ["/audit.csv"], "which is of every participant"


def test_no_page_meets_its_reader_with_words_of_the_methods_and_energy_has_one_unit(world: World) -> None:
    reader = TestClient(world.app, headers={"Accept": "text/html"}, follow_redirects=False)
    assert reader.post("/sign-in", data={"email": "admin@clinic.example", "password": PASSWORD}).status_code == 303
    found: dict[str, list[str]] = {}
    shares, counts, figures, linked = [], {}, 0, set()
    jobs = {f"a job of the kind {kind}": path for kind, path in ended_jobs(world).items()}
    assert len(jobs) == 4
    for route, path in (addresses(world) | jobs).items():
        with reader.stream("get", path) as answer:
            if answer.status_code != 200 or not answer.headers["content-type"].startswith("text/html"):
                continue
            page = answer.read().decode()
        drawn = drawn_above_fold(page, lambda src: str(reader.get(src).text))
        figures += bool(drawn)
        found[route] = methods_named(f"{above_fold(page)} | {drawn}")
        linked |= {route} if '<a href="/glossary">Glossary</a>' in page else set()
        # a number in one element and a noun in the next are no count
        counts[route] = miscounted(" ".join(re.sub("<[^>]+>", " | ", page).split()))
        # the REST interface keeps shares of the energy under cDBS, and its reference says so
        shares += [route] if "cDBS = 1" in page and route != "/api-reference" else []
    failed = reader.get(jobs["a job of the kind failed"]).text
    assert re.search(r"The job failed.*A step failed: \w[^<]+\.", above_fold(failed))
    assert "ValueError: the DLSM needs at least 4 sessions in the buffer" in failed, "engineers read it in their fold"
    assert len(found) >= 50
    assert figures >= 9
    assert set(found) - linked <= WITHOUT_A_READER, "the words are explained one click away"
    assert {route for route, words in found.items() if words} == set(METHODS_EXPLAINED), {r: w for r, w in found.items() if w}
    assert {route: said for route, said in counts.items() if said} == {}
    assert shares == [], "energy is told in % of cDBS"


def test_no_figure_of_an_address_of_its_own_names_a_method(world: World) -> None:
    reader = TestClient(world.app, headers={"Accept": "application/json"}, follow_redirects=False)
    assert reader.post("/sign-in", data={"email": "admin@clinic.example", "password": PASSWORD}).status_code == 303
    metrics = re.findall(r'data-src="([^"]+)"', reader.get("/analyses", headers={"Accept": "text/html"}).text)
    assert len(metrics) >= 3
    for path in [*(m.replace("&amp;", "&") for m in metrics), addresses(world)["/sessions/{session_id}/signal.json"]]:
        answer = reader.get(path)
        assert answer.status_code == 200, path
        words = " | ".join(drawn(answer.json()))
        assert words, path
        assert methods_named(words) == [], path


def test_no_script_says_a_word_of_the_methods() -> None:
    scripts = sorted(p for p in STATIC.rglob("*.js"))
    assert len(scripts) >= 10
    said = {p.name: said_by_script(p.read_text()) for p in scripts}
    assert any("The connection broke off" in text for text in said["upload.js"])
    assert any("could not be drawn" in text for text in said["charts.js"])
    # `[` after an e is a selector or a spread here, no expectation
    found = {name: {text: hit for text in texts if (hit := [w for w in methods_named(text) if w != "E["])} for name, texts in said.items()}
    assert {name: hits for name, hits in found.items() if hits} == {}


def test_words_of_figures_and_scripts_are_read() -> None:
    figure = {"data": [{"name": "DLSM", "x": ["P1"], "meta": "FQE"}], "layout": {"xaxis": {"title": {"text": "Mean Q"}}}}
    page = f'<main><script type="application/json">{json.dumps(figure)}</script></main>'
    assert methods_named(drawn_above_fold(page, str)) == ["DLSM", "Mean Q"]
    folded = f'<main><details><script type="application/json">{json.dumps(figure)}</script></details></main>'
    assert drawn_above_fold(folded, str) == ""
    fetched = '<script type="application/json" data-src="/f"></script>'
    assert methods_named(drawn_above_fold(fetched, lambda path: json.dumps(figure) if path == "/f" else "")) == ["DLSM", "Mean Q"]
    script = "// the critic's buffer\nconst a = /[\"'`]/; say(`${n} of the posterior`); b = 'buffer'; c = \"Horizon\";"
    assert said_by_script(script) == ["  of the posterior", "Horizon"]
