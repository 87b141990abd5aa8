"""Describe the requests of the operator's page, as an OpenAPI document, from the server's routes.

Methods and paths are those of the routes of `rigd.web`, and the commands those of the control
socket. A summary is the first sentence of the docstring, unless `REQUESTS` replaces it. `REQUESTS`
adds what the code of a route does not declare; a route without an entry there, or an entry without
a route, ends the build.
"""

import inspect
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import rigd
from rigd.daemon import _page, _protocol
from rigd.profile import load_profile
from rigd.web import _library, _server

Document = dict[str, Any]

SCHEMAS = "#/components/schemas/"
TEXT: Document = {"type": "string"}
JSON, HTML, BYTES = "application/json", "text/html", "application/octet-stream"
PATH_PARAMETERS = {
    "id": {**TEXT, "description": "name of the session's file without `.mcap`"},
    "ending": {"enum": ["mcap", *_library._EXPORT_SUFFIXES]},
    "name": TEXT,
    "file": {**TEXT, "pattern": f"^{_library._REPORT_FILE_NAME.pattern}$"},
}
"""Schemas of the parts of a path in braces."""
ERRORS = {
    400: "the request is wrong",
    403: "the token is missing, or the request comes from another page",
    404: "there is none of that name",
    409: "refused now; the same request may succeed later",
    503: "the daemon cannot be reached",
}


def query(name: str, schema: Document, description: str = "") -> Document:
    """Return a parameter in the query of an address."""
    return {"name": name, "in": "query", "schema": schema, "description": description}


def whole_number(default: int) -> Document:
    """Return the schema of a whole number with a default."""
    return {"type": "integer", "minimum": 0, "default": default}


def listed(name: str, item: Document) -> Document:
    """Return the schema of a member that is a list."""
    return {name: {"type": "array", "items": item}}


def an_object(**members: Document) -> Document:
    """Return the schema of an object that has all members, and may have others."""
    return {"type": "object", "properties": members, "required": list(members)}


QUEUED = {202: (JSON, an_object(ok={"const": True}, job={"type": "integer"}))}
"""Reply to a request for a job, with the number that messages of the type `job` state."""
OPTIONAL_TOKEN = (
    "yes, except for `stop`, and for `predict` unless `parameters` has a `path` (a file)"
)
SESSION_NAMES = {**listed("ids", TEXT)["ids"], "minItems": 2}
REQUESTS: dict[str, Document] = {
    "GET /": {"summary": "Send the page.", "replies": {200: (HTML, TEXT)}},
    "GET /static/{name}": {
        "summary": "Send another file of the page; `{name}` is the name of the file.",
        "replies": {200: (BYTES, TEXT)},
        "errors": (404,),
    },
    "GET /favicon.ico": {
        "summary": "Send the icon of the page.",
        "replies": {200: ("image/svg+xml", TEXT)},
    },
    "GET /api/live": {"replies": {101: None}},
    "POST /api/command": {
        "body": {"$ref": f"{SCHEMAS}Command"},
        "token": "optional",
        "description": "No token: only stop, and predict if parameters has no path.",
        "replies": {200: (JSON, an_object(reply=TEXT, ok={"const": True}))},
        "errors": (400, 403, 409, 503),
    },
    "GET /api/sessions": {
        "query": [
            *(query(name, TEXT) for name in _library._FILTER_NAMES),
            query("limit", whole_number(_library._DEFAULT_ROW_LIMIT)),
            query("offset", whole_number(0)),
        ],
        "replies": {
            200: (
                JSON,
                an_object(total={"type": "integer"}, **listed("sessions", {"type": "object"})),
            )
        },
        "errors": (400,),
    },
    "GET /api/sessions/{id}/file.{ending}": {
        "replies": {200: (BYTES, TEXT)},
        "errors": (404, 409),
    },
    "GET /api/sessions/{id}/look": {
        "replies": {200: (JSON, {"type": "object"})},
        "errors": (404,),
    },
    "GET /api/sessions/{id}/report/": {
        "summary": "Send the page of the last analysis report of a session.",
        "replies": {200: (HTML, TEXT)},
        "errors": (404,),
    },
    "GET /api/sessions/{id}/report/{name}": {
        "summary": "Send another file of this report; `{name}` is the name of the file.",
        "replies": {200: (BYTES, TEXT)},
        "errors": (404,),
    },
    "POST /api/sessions/{id}/report": {
        "token": "required",
        "replies": QUEUED,
        "errors": (403, 404, 409),
    },
    "GET /api/campaign/{name}/": {
        "summary": "Send the page of the analysis report of a campaign; `{name}` is the name of "
        "the report's folder, such as `campaign.report`.",
        "replies": {200: (HTML, TEXT)},
        "errors": (404,),
    },
    "GET /api/campaign/{name}/{file}": {
        "summary": "Send another file of this report; `{file}` is the name of the file.",
        "replies": {200: (BYTES, TEXT)},
        "errors": (404,),
    },
    "POST /api/campaign": {
        "body": an_object(ids={**SESSION_NAMES, "maxItems": _library._MAX_CAMPAIGN_SESSIONS}),
        "token": "required",
        "replies": QUEUED,
        "errors": (400, 403, 404, 409),
    },
    "GET /api/frf": {
        "query": [
            {
                **query(
                    "ids", TEXT, f"1 to {_library._MAX_COMPARED_RESPONSES} names, comma-separated"
                ),
                "required": True,
            }
        ],
        "replies": {
            200: (
                JSON,
                an_object(**listed("responses", {"type": "object"}), **listed("errors", TEXT)),
            )
        },
        "errors": (400, 404),
    },
}
"""Parameters, bodies and replies of each method and path, with a summary if routes share one."""


def page_document() -> Document:
    """Return the OpenAPI document of the page's server."""
    routes = dict(page_routes())
    if routes.keys() != REQUESTS.keys():
        raise ValueError(f"REQUESTS and routes differ: {sorted(routes.keys() ^ REQUESTS.keys())}")
    paths: dict[str, Document] = {}
    for name, summary in routes.items():
        method, path = name.split(" ")
        paths.setdefault(path, {})[method.lower()] = operation(path, method, summary)
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "Server of the operator's page of rigd",
            "version": rigd.__version__,
            "license": {"name": "BSD-3-Clause", "identifier": "BSD-3-Clause"},
        },
        "servers": [{"url": "http://127.0.0.1:8720"}],
        "paths": paths,
        "components": {
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
            "schemas": {
                **command_schemas(),
                "Refusal": an_object(
                    ok={"const": False}, error=TEXT, wrong_use={"type": "boolean"}
                ),
            },
        },
    }


def page_routes() -> Iterator[tuple[str, str]]:
    """Yield method and path of each route with the first sentence of its handler's docstring."""
    job = _page._page_job(load_profile("sim"), Path(), Path()) | {"token": ""}
    for route in _server.OperatorPageServer(job).application().router.routes():
        if route.method != "HEAD" and route.resource is not None:
            text = inspect.getdoc(route.handler) or ""
            yield f"{route.method} {route.resource.canonical}", text.partition("\n")[0]


def operation(path: str, method: str, summary: str) -> Document:
    """Return the description of one method of one path."""
    request = REQUESTS[f"{method} {path}"]
    parameters = [
        {"name": name, "in": "path", "required": True, "schema": schema}
        for name, schema in PATH_PARAMETERS.items()
        if f"{{{name}}}" in path
    ]
    parameters += request.get("query", [])
    if method == "POST":  # no form and no page of another origin can send it
        header = {"name": "X-Rigd", "in": "header", "required": True, "schema": {"const": "1"}}
        parameters.append(header)
    replies: Document = {}
    for status, content in request["replies"].items():
        replies[str(status)] = {"description": "WebSocket" if content is None else "done"}
        if content is not None:
            replies[str(status)]["content"] = {content[0]: {"schema": content[1]}}
    refusal = {JSON: {"schema": {"$ref": f"{SCHEMAS}Refusal"}}}
    for status in request.get("errors", ()):
        replies[str(status)] = {"description": ERRORS[status], "content": refusal}
    summary = request.get("summary", summary)
    described: Document = {"summary": summary, "parameters": parameters, "responses": replies}
    if "description" in request:
        described["description"] = request["description"]
    if "body" in request:
        described["requestBody"] = {
            "required": True,
            "content": {JSON: {"schema": request["body"]}},
        }
    if "token" in request:
        described["security"] = [{"token": []}]
        if request["token"] == "optional":  # stop and most predict need none
            described["security"].append({})
    return described


def command_schemas() -> Document:
    """Return the schemas of the commands that the page may send, as the socket checks them."""
    schema = _protocol._REQUEST_VALIDATOR.json_schema(ref_template=f"{SCHEMAS}{{model}}")
    mapping = schema["discriminator"]["mapping"]
    permitted = {name: mapping[name] for name in sorted(_server._PAGE_COMMANDS)}
    left_out = {mapping[name].removeprefix(SCHEMAS) for name in mapping.keys() - permitted.keys()}
    return {
        "Command": {
            "oneOf": [{"$ref": reference} for reference in permitted.values()],
            "discriminator": {"propertyName": "command", "mapping": permitted},
        },
        **{name: each for name, each in schema["$defs"].items() if name not in left_out},
    }


def page_rows(document: Document) -> list[tuple[str, ...]]:
    """Return a row for each request: method and path, what it does, whether it needs the token."""
    rows = []
    for path, methods in document["paths"].items():
        for method, described in methods.items():
            queries = [each for each in described["parameters"] if each["in"] == "query"]
            names = ", ".join(f"`{each['name']}`" for each in queries)
            text = f"{described['summary']} Query: {names}." if names else described["summary"]
            token = {0: "", 1: "yes", 2: OPTIONAL_TOKEN}
            rows.append(
                (f"`{method.upper()} {path}`", text, token[len(described.get("security", ()))])
            )
    return rows
