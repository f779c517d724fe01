"""Templates are formatted, and the formatter never changes a page."""

from __future__ import annotations

import pytest

from tests.architecture.templates import FOLDER, WIDTH, meaning, reformat


@pytest.mark.parametrize("path", sorted(FOLDER.rglob("*.html")), ids=lambda path: str(path.relative_to(FOLDER)))
def test_every_template_is_formatted(path) -> None:  # type: ignore[no-untyped-def]
    source = path.read_text()
    assert reformat(source) == source, "run `make format`"


WORD = "w" * WIDTH
WORDS = "word " * (2 * WIDTH // 5)


@pytest.mark.parametrize(
    ("source", "result"),
    [
        (f"<p>{WORD}</p><p>next</p>", f"<p>{WORD}</p>\n<p>next</p>"),
        (f"<p>{{% if x %}}{WORD}{{% endif %}}.</p>", f"<p>{{% if x %}}\n{WORD}{{% endif %}}\n.</p>"),
        (f'{{{{ call("{WORD}", second) }}}}', f'{{{{ call("{WORD}",\n  second) }}}}'),
        (f'<a href="{WORD}" title="b">c</a>', f'<a href="{WORD}"\n  title="b">c</a>'),
    ],
    ids=["blocks", "statements", "arguments", "attributes"],
)
def test_a_long_line_breaks_where_nothing_is_drawn(source: str, result: str) -> None:
    assert reformat(source) == result
    assert reformat(result) == result
    assert meaning(source) == meaning(result)


@pytest.mark.parametrize(
    "source",
    [f"<pre>{WORDS}</pre>", f"<textarea>{WORDS}</textarea>", f'{{{{ "{WORDS}" }}}}', f'<i title="{WORDS}"></i>'],
    ids=["pre", "textarea", "string", "attribute"],
)
def test_words_stay_on_a_line_where_a_break_would_be_seen(source: str) -> None:
    assert WORDS in reformat(source)


@pytest.mark.parametrize(
    ("one", "other"),
    [
        ("<b>a</b><i>b</i>", "<b>a</b>\n<i>b</i>"),
        ("{% if x %}a{% endif %} b", "{% if x %}a{% endif %}\nb"),
        ("a{{ b }}", "a\n{{ b }}"),
        ("{{ a or b }}", "{{ a and b }}"),
    ],
)
def test_what_a_browser_would_show_otherwise_is_another_meaning(one: str, other: str) -> None:
    assert meaning(one) != meaning(other)
