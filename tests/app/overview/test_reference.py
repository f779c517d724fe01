"""The pages for those who build on betaloop: the REST interface by its own description, the components in development alone."""

from __future__ import annotations

import pytest
from fastapi.testclient import TestClient

from app.overview.reference_web import operations, schemas, type_in_words
from app.settings import get_settings

HTML = {"Accept": "text/html"}


def test_every_route_and_every_object_of_the_interface_is_on_its_page(client: TestClient) -> None:
    document = client.get("/api/v1/openapi.json").json()
    page = client.get("/api-reference", headers=HTML).text
    described = [o for group in operations(document).values() for o in group]
    assert len(described) == sum(len(entry) for entry in document["paths"].values())
    assert all(f"<b>{o.method}</b> {o.path}" in page for o in described)
    assert all(f'id="s-{name}"' in page for name in schemas(document))
    assert "//cdn" not in page


@pytest.mark.parametrize(
    ("schema", "words"),
    [
        ({"$ref": "#/components/schemas/JobOut"}, "JobOut"),
        ({"type": "array", "items": {"type": "number"}}, "list of number"),
        ({"anyOf": [{"type": "integer"}, {"type": "null"}]}, "whole number or null"),
        ({"type": "string", "format": "date"}, "date"),
        ({"enum": ["left", "right"], "type": "string"}, "left | right"),
        ({}, "any"),
    ],
)
def test_types_are_said_in_words(schema: dict[str, object], words: str) -> None:
    assert type_in_words(schema) == words


def test_the_style_guide_is_there_in_development_alone(client: TestClient, monkeypatch: pytest.MonkeyPatch) -> None:
    assert client.get("/styleguide", headers=HTML).status_code == 404
    monkeypatch.setattr(get_settings(), "development", True)
    assert "What pages are made of" in client.get("/styleguide", headers=HTML).text
