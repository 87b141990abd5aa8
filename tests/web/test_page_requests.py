"""The OpenAPI document of the page's requests is complete, and the server conforms to it."""

import importlib.util
import json
from pathlib import Path

import pytest
from jsonschema import Draft202012Validator
from web_daemon import TOKEN

DOCS = Path(__file__).parents[2] / "docs"
ACTING = {"X-Rigd": "1", "Content-Type": "application/json"}
TOKEN_HEADER = {"Authorization": f"Bearer {TOKEN}"}


@pytest.fixture(scope="module")
def document():
    spec = importlib.util.spec_from_file_location("page_requests", DOCS / "page_requests.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)  # fails if a route is missing in it
    return json.loads(json.dumps(module.page_document()))


def errors_of(document, schema, value):
    """Errors of a value by a schema that refers to others of the document."""
    whole = schema | {"components": document["components"]}
    return [each.message for each in Draft202012Validator(whole).iter_errors(value)]


def test_schemas_are_valid(document):
    schemas = document["components"]["schemas"]
    assert {"Command", "Refusal", "StartRequest"} <= schemas.keys()
    assert "WatchRequest" not in schemas  # not one that the page passes on
    for schema in schemas.values():
        Draft202012Validator.check_schema(schema)
    references = set(json.dumps(document).split('"#/components/schemas/')[1:])
    assert {each.partition('"')[0] for each in references} <= schemas.keys()


@pytest.mark.parametrize(
    ("method", "address", "path", "body", "status"),
    [
        ("GET", "/api/sessions?limit=2", "/api/sessions", None, 200),
        ("GET", "/api/sessions?limit=x", "/api/sessions", None, 400),
        ("GET", "/api/sessions/none/look", "/api/sessions/{id}/look", None, 404),
        ("GET", "/api/frf", "/api/frf", None, 400),
        ("POST", "/api/command", "/api/command", {"command": "stop"}, 200),
        ("POST", "/api/command", "/api/command", {"command": "tare"}, 200),
        ("POST", "/api/command", "/api/command", {"command": "watch"}, 400),
        ("POST", "/api/campaign", "/api/campaign", {"ids": ["one"]}, 400),
        ("POST", "/api/campaign", "/api/campaign", {"ids": ["one", "two"]}, 404),
    ],
)
def test_the_server_answers_as_documented(served, document, method, address, path, body, status):
    described = document["paths"][path][method.lower()]
    headers, sent = {}, b""
    if body is not None:
        schema = described["requestBody"]["content"]["application/json"]["schema"]
        assert bool(errors_of(document, schema, body)) == (status == 400)
        headers, sent = ACTING | TOKEN_HEADER, json.dumps(body).encode()
    answered, _, reply = served.request(method, address, headers, sent)
    assert answered == status
    content = described["responses"][str(status)]["content"]["application/json"]
    assert not errors_of(document, content["schema"], json.loads(reply))


def test_requests_without_a_required_token_are_refused(served, document):
    for path, methods in document["paths"].items():
        described = methods.get("post", {})
        if described.get("security") == [{"token": []}]:
            address = path.replace("{id}", "none")
            answered, _, reply = served.request("POST", address, ACTING, b'{"ids": []}')
            assert answered == 403
            assert json.loads(reply)["ok"] is False
    commands = {"tare": 403, "stop": 200}
    for command, status in commands.items():
        body = json.dumps({"command": command}).encode()
        assert served.request("POST", "/api/command", ACTING, body)[0] == status
