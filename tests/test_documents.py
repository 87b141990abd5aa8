"""Documents that users write: read, or refused in one sentence and in bounded memory."""

import os
import sys

import pytest

from rigd.documents import DocumentError, parse_toml, read_json, read_text

NESTED = 20_000


def test_valid_document_is_read(tmp_path):
    path = tmp_path / "a"
    path.write_text('\ufeffa = { value = 1.5, source = "measured" }\n', encoding="utf-8")
    assert parse_toml(read_text(path)) == {"a": {"value": 1.5, "source": "measured"}}
    path.write_text('{"a": [1, {"b": null}]}')
    assert read_json(path) == {"a": [1, {"b": None}]}


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("a = " + "[\n" * NESTED + "]\n" * NESTED, "nested too deeply"),
        ("a = " + "{ b = " * 300 + "1" + " }" * 300, "nested"),
        ("a" + ".a" * 100 + " = 1", "nested deeper than 16 levels"),
        ("[a" + ".a" * 2_000_000 + "]", "characters"),
        ("[a" + ".a" * 10_000 + "]", "a line of more than 4096 characters"),
        ("a = " + "9" * 4097, "characters"),
        ("a = 0." + "9" * 4097, "characters"),
        ("\n".join(f"[t{i}]" for i in range(10_000)), "more than 3000 keys"),
        ("a = [" + "\n1," * 10_000 + "]", "more than 3000 keys"),
        ("# comment\n" * 100_000, "250000 characters"),
        ("a = \0", "not valid TOML"),
    ],
    ids=lambda given: given[:12] if isinstance(given, str) else None,
)
def test_too_long_text_is_refused(text, words):
    with pytest.raises(DocumentError, match=words):
        parse_toml(text)


def test_digits_beyond_the_interpreter_limit():
    before = sys.get_int_max_str_digits()
    sys.set_int_max_str_digits(1000)
    try:
        with pytest.raises(DocumentError, match="too many digits"):
            parse_toml("a = " + "9" * 2000)
    finally:
        sys.set_int_max_str_digits(before)


@pytest.mark.parametrize(
    ("data", "words"),
    [
        (b"[" * 200_000, "nested too deeply"),
        (b"9" * 5000, "not a JSON document"),
        (b"{", "not a JSON document"),
        (b"\xff", "UTF-8"),
        (b" " * 2000, "at most 0.001 MB"),
    ],
)
def test_too_large_json_is_refused(tmp_path, data, words):
    path = tmp_path / "a.json"
    path.write_bytes(data)
    with pytest.raises(DocumentError, match=words):
        read_json(path, 1000 if words.startswith("at most") else 12_000_000)


def test_special_files_are_refused_without_waiting(tmp_path):
    pipe, loop = tmp_path / "pipe", tmp_path / "loop"
    os.mkfifo(pipe)
    loop.symlink_to(loop)
    for path in (pipe, loop, tmp_path, tmp_path / "none", tmp_path.joinpath("a\0b")):
        with pytest.raises(DocumentError, match="cannot be read"):
            read_text(path)
    with pytest.raises(DocumentError, match="cannot be read"):
        read_text(tmp_path.joinpath("/dev/zero"))
