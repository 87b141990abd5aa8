"""Requests from any client: parsed, or refused by a message that names the error."""

import inspect
import json
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st
from operated_daemons import RequestError, StartRequest, parse_request

from rigd.excitation import KINDS, ExcitationError, make_excitation

START = {"command": "start", "excitation": "chirp"}


def parse(document):
    return parse_request(json.dumps(document).encode())


@pytest.mark.parametrize("command", ["status", "watch", "stop", "tare", "zero", "reset", "check"])
def test_plain_commands(command):
    request = parse({"command": command, "id": 7})
    assert (request.command, request.id) == (command, 7)


def test_start_has_the_parameters_of_its_excitation():
    request = parse(START | {"parameters": {"amplitude_rad": 1, "stop_hz": 20.5}, "repeat": 3})
    assert isinstance(request, StartRequest)
    assert request.parameters == {"amplitude_rad": 1.0, "stop_hz": 20.5}
    assert request.repeat == 3
    request = parse(
        {"command": "start", "excitation": "file", "parameters": {"path": "/data/reference.csv"}}
    )
    assert request.parameters == {"path": Path("/data/reference.csv")}


def test_there_and_back_is_a_whole_number():
    parameters = {"there_and_back": 1, "duration_s": 60.0}
    assert parse(START | {"excitation": "chirp", "parameters": parameters}).parameters == parameters
    with pytest.raises(RequestError, match=r"there_and_back = 1\.5 is not a whole number"):
        parse(START | {"excitation": "chirp", "parameters": {"there_and_back": 1.5}})


def test_target_precision_is_a_text():
    parameters = {"targets": "damping 1%; alpha 0.03", "at_most_s": 60.0}
    assert parse(START | {"excitation": "until", "parameters": parameters}).parameters == parameters
    assert parse(START | {"watch_fit": True}).watch_fit
    parameters |= {"uniformity_percent": 0.0}
    assert parse(START | {"excitation": "until", "parameters": parameters}).parameters == parameters
    assert not parse(START).watch_fit


def test_predict_has_the_fields_of_a_start():
    request = parse(START | {"command": "predict", "parameters": {"stop_hz": 20}, "force": True})
    assert (request.parameters, request.force) == ({"stop_hz": 20.0}, True)
    assert not request.is_controlling
    with pytest.raises(RequestError, match="wobble"):
        parse(START | {"command": "predict", "parameters": {"wobble": 1}})


def test_watch_with_and_without_signals():
    assert not parse({"command": "watch"}).signals
    assert parse({"command": "watch", "signals": True}).signals
    with pytest.raises(RequestError, match="signals"):
        parse({"command": "watch", "signals": 1})


@pytest.mark.parametrize(
    ("line", "named"),
    [
        (b"", "JSON"),
        (b"{", "JSON"),
        (b"[]", "object"),
        (b"7", "object"),
        (b'"status"', "object"),
        (b"\xff\xfe", "UTF-8"),
        (b"[" * 30_000, "nested|JSON"),  # as deep as this Python goes
        (b'{"command":' * 5_000, "nested|JSON"),
        (b'{"command": NaN}', "NaN"),
        (b'{"command": ' + b"9" * 5000 + b"}", "JSON"),
        (b"{}", "command"),
        (b'{"command": "fire"}', "fire"),
        (b'{"command": ["status"]}', "command"),
        (b'{"command": "status", "more": 1}', "more"),
        (b'{"command": "status", "id": 1.5}', "id"),
        (b'{"command": "status", "id": true}', "id"),
        (b'{"command": "status", "id": "' + b"x" * 65 + b'"}', "at most 64"),
    ],
)
def test_error_names_the_defect_of_a_request(line, named):
    with pytest.raises(RequestError, match=named):
        parse_request(line)


@pytest.mark.parametrize(
    ("fields", "named"),
    [
        ({"excitation": "dance"}, "dance"),
        ({"excitation": 3}, "excitation"),
        ({"parameters": {"amplitude": 1.0}}, "amplitude"),
        ({"parameters": {"rate_hz": 10.0}}, "rate_hz"),
        ({"parameters": {"amplitude_rad": "1"}}, "amplitude_rad"),
        ({"parameters": {"amplitude_rad": True}}, "amplitude_rad"),
        ({"parameters": {"amplitude_rad": None}}, "amplitude_rad"),
        ({"parameters": {"amplitude_rad": [1.0]}}, "amplitude_rad"),
        ({"parameters": {"amplitude_rad": 10**400}}, "amplitude_rad"),
        ({"parameters": [1.0]}, "parameters"),
        ({"excitation": "multisine", "parameters": {"seed": 1.0}}, "seed"),
        ({"excitation": "multisine", "parameters": {"seed": 10**30}}, "seed"),
        ({"excitation": "file"}, "path is missing"),
        ({"excitation": "file", "parameters": {"path": "reference.csv"}}, "absolute"),
        ({"excitation": "file", "parameters": {"path": "/a\u0000b"}}, "path"),
        ({"excitation": "file", "parameters": {"path": "/a\ud800"}}, "path"),
        ({"excitation": "until"}, "targets is missing"),
        ({"excitation": "until", "parameters": {"targets": 1}}, "targets = 1 is not plain text"),
        ({"excitation": "until", "parameters": {"targets": "damping\n1%"}}, "not plain text"),
        ({"excitation": "until", "parameters": {"targets": "x" * 1001}}, "1000 characters"),
        ({"watch_fit": 1}, "watch_fit"),
        ({"repeat": 0}, "repeat"),
        ({"repeat": 10_000}, "repeat"),
        ({"repeat": 1.0}, "repeat"),
        ({"notes": {"operator": "two\nlines"}}, "operator"),
        ({"notes": {"weather": "fine"}}, "weather"),
        ({"notes": {"meta": {"temperature_c": "warm"}}}, "notes.meta: .*temperature_c"),
        ({"notes": {"meta": {"temperature_c": None}}}, "notes.meta: .*temperature_c"),
        ({"notes": {"meta": {"__class__": 1}}}, "notes.meta: .*__class__"),
        ({"notes": {"meta": {"operator": "Ada"}}}, "give it as operator"),
        ({"notes": {"meta": ["temperature_c"]}}, "notes.meta"),
        ({"notes": {"meta": {f"n{i}": "x" for i in range(40)}}}, "40 names"),
        ({"force": "yes"}, "force"),
    ],
)
def test_error_names_the_wrong_field_of_a_start(fields, named):
    with pytest.raises(RequestError, match=named):
        parse(START | fields)


def test_notes_as_metadata_of_the_file():
    meta = {"temperature_c": 21, "humidity_percent": "40", "batch": "B 7"}
    request = parse(START | {"notes": {"operator": "Ada", "note": "", "meta": meta}})
    assert request.notes.as_metadata() == {
        "operator": "Ada", "meta_temperature_c": "21.0", "meta_humidity_percent": "40.0",
        "meta_batch": "B 7",
    }  # fmt: skip


def test_an_overflowing_number_is_refused():
    with pytest.raises(RequestError, match="amplitude_rad"):
        parse_request(
            b'{"command": "start", "excitation": "step", "parameters": {"amplitude_rad": 1e999}}'
        )


def test_refusal_has_the_id_of_the_request():
    with pytest.raises(RequestError) as refused:
        parse({"command": "fire", "id": "mine"})
    assert refused.value.request_id == "mine"


@settings(max_examples=100)
@given(st.binary(max_size=300))
@example(b'{"command": "status"}')
def test_any_bytes_are_parsed_or_refused(line):
    try:
        parse_request(line)
    except RequestError as error:
        assert str(error)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(st.text(), inner, max_size=3),
    max_leaves=10,
)
NAMES = sorted({name for make in KINDS.values() for name in inspect.signature(make).parameters})


@settings(max_examples=50)
@given(
    kind=st.sampled_from([*KINDS, "dance"]),
    parameters=st.dictionaries(st.sampled_from(NAMES), JSON | st.floats(-10.0, 100.0), max_size=4),
    more=st.dictionaries(st.sampled_from(["repeat", "notes", "force", "id"]), JSON, max_size=2),
)
def test_any_start_is_made_or_refused(kind, parameters, more):
    line = json.dumps(
        {"command": "start", "excitation": kind, "parameters": parameters, **more}
    ).encode()
    try:
        request = parse_request(line)
        assert isinstance(request, StartRequest)
        make_excitation(request.excitation, request.parameters, 100.0)
    except (RequestError, ExcitationError) as error:
        assert str(error)
