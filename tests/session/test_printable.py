import pytest

from rigd.printable import printable


@pytest.mark.parametrize(
    ("text", "shown"),
    [
        ("Größe 5 µm", "Größe 5 µm"),
        ("", ""),
        ("red\x1b[31m", "red?[31m"),
        ("a\nb\tc\r\nd\u2028e", "a?b?c??d?e"),
        ("\x00\x9b\u202e\ud800", "????"),
    ],
)
def test_control_characters_are_marked(text, shown):
    assert printable(text) == shown
    assert printable(text).isprintable()


@pytest.mark.parametrize(("most", "shown"), [(2, "ab…"), (3, "abc"), (None, "abc")])
def test_long_text_is_cut(most, shown):
    assert printable("abc", most) == shown
