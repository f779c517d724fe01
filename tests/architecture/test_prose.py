"""Prose follows its rules: breaches may only become fewer, by rule and folder. `python -m tests.architecture.prose` lists them."""

from __future__ import annotations

import ast

import pytest

from tests.architecture import prose, texts
from tests.architecture.measure import ratchet, unlike_record


@pytest.mark.parametrize("rule", prose.RULES)
def test_no_rule_is_broken_more_often(rule: str) -> None:
    found = prose.counts(prose.findings())[rule]
    details = {
        folder: [f"{f.path}:{f.line}: {f.about}" for f in prose.findings() if (f.rule, f.folder) == (rule, folder)] for folder in found
    }
    values = found | {folder: found.get(folder, 0) for folder in ratchet()[rule]}
    assert unlike_record(values, rule, {name: places[-5:] for name, places in details.items()}) == []


def test_subjects_of_commits_state_the_effect() -> None:
    rule = ratchet()["subjects"]
    subjects = prose.subjects(rule["since"])
    if subjects is None:
        pytest.skip("the history is not here")
    wrong = [f"{subject}: {problem}" for subject in subjects if (problem := prose.wrong_subject(subject))]
    assert len(wrong) <= rule["wrong"], wrong


def sentences(text: str) -> list[str]:
    return list(prose.sentences(text))


def test_sentences_end_where_a_reader_ends_them() -> None:
    assert sentences("One, e.g. this. Two (see 3.4). `code.py` is three.") == ["One, e.g. this.", "Two (see 3.4).", "x is three."]
    assert sentences("Fit it.\n\n    Args:\n        a: the first\n            of two. More\n        b: the second") == [
        "Fit it.", "a: the first of two.", "More", "b: the second",
    ]  # fmt: skip
    assert sentences("* an item\n* another item\n  of two lines") == ["* an item", "* another item of two lines"]
    assert sentences("Text\n>>> code(here)\nmore text") == ["Text", "more text"]


def test_words_are_counted_without_formulas_and_numbers() -> None:
    assert prose.word_count("the mean of 3 steps is x_1 + 2 = y, in Hz") == 8


def text_nodes(kind: str, text: str) -> list[str]:
    found = texts.template_texts(text) if kind == "html" else texts.document_texts(text)
    return [" ".join(t.split()) for _, t in found]


def test_templates_are_read_as_people_see_them() -> None:
    page = '<p title="A short hint">One <b>bold</b> word{% if x %} more{% endif %}</p><script>var a = 1</script><td>{{ name }} ends</td>'
    assert text_nodes("html", page) == ["A short hint", "One bold word", "more", "x ends"]
    assert text_nodes("html", "{# a comment #}<p>text</p>") == ["a comment", "text"]


def test_documents_are_read_without_code_and_tables() -> None:
    page = "# Title\n\nA paragraph\nof two lines.\n* item\n\n```\ncode here\n```\n| a | table |\n![picture](x.png)\n"
    assert text_nodes("md", page) == ["Title", "A paragraph of two lines.", "item"]


def test_comments_and_messages_are_found_and_strings_are_not_comments() -> None:
    code = 'x = "# no comment"  # a comment\n# one\n# text\ny = """\n# inside\n"""  # noqa: E501\nraise Error(f"no {x} here")\n'
    nodes = texts.sorted_nodes(ast.parse(code))
    assert [" ".join(t.split()) for _, t in texts.comments(code, nodes)] == ["a comment", "one text"]
    assert [t for _, t in texts.messages(nodes)] == ["no x here"]


@pytest.mark.parametrize(
    ("code", "wrong"),
    [
        ("def f():\n    'Return the mean.'", False),
        ("def f():\n    'The mean.'", True),
        ("def f():\n    'Whether it is one.'", True),
        ("def f():\n    'Draw of a step.'", True),
        ("def test_f():\n    'Both agree.'", False),
        ("@property\ndef f():\n    'Mean of the steps.'", False),
        ("@property\ndef f():\n    'What it is.'", True),
        ("class A:\n    'Draws of a posterior.'", False),
        ("class A:\n    'What is drawn.'", True),
        ("class A:\n    'Draw the steps.'", True),
    ],
)
def test_docstrings_begin_with_a_verb_or_a_noun(code: str, wrong: bool) -> None:
    (found,) = [n for n in texts.docstrings(texts.sorted_nodes(ast.parse(code))) if n[0] is not None]
    assert prose.wrong_first_word(found[0], str(found[1].value)) is wrong  # type: ignore[arg-type]


def test_names_are_no_participles_and_no_prepositions() -> None:
    wrong = ["told", "_kept", "of", "judged", "grounds", "fitted"]
    right = ["seed", "speed", "Found", "held_out", "fit", "left", "FIXED", "need"]
    assert [name for name in wrong + right if prose.wrong_name(name)] == wrong


def test_flags_may_be_participles() -> None:
    code = "def f(locked: bool, told: int) -> bool: ...\ndef closed(self) -> bool: ...\ndef opened(self) -> int: ..."
    names = [name for _, name in prose.names_in(texts.sorted_nodes(ast.parse(code)))]
    assert sorted(names) == ["opened", "self", "self", "told"]


def test_private_words_are_found_in_prose_alone() -> None:
    found = [
        m[0] for m in prose.BANNED.finditer(prose.plain("It stands beside `told`, held-out sessions are held against somebody of before."))
    ]
    assert found == ["stands", "beside", "held", "somebody", "of before"]


@pytest.mark.parametrize(
    ("subject", "right"),
    [
        ("Count a serious event against a policy's teacher and student", True),
        ("Embed the font in the report", True),
        ("Process uploads in order", True),
        ("What a policy is planned by", False),
        ("Added a table", False),
        ("Fixes the page", False),
        ("Hold a serious event beside its policy", False),
        ("Measure " + "a long thing " * 6, False),
    ],
)
def test_subjects_are_imperatives(subject: str, right: bool) -> None:
    assert (prose.wrong_subject(subject) is None) is right
