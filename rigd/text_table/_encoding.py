"""Encoding of a text file: by its byte order mark, else UTF-8, else Windows-1252."""

import codecs
from typing import Final

_MARKS: Final = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),  # first, because the mark of UTF-16 is its prefix
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_LONGEST_MARK: Final = 4


def encodings(head: bytes) -> tuple[str, ...]:
    """Return the possible encodings from the first bytes of a file, the most probable first.

    Most programs without UTF-8 write Windows-1252. Numbers have the same bytes in both encodings;
    only titles and units can differ.
    """
    marked = _marked(head)
    if marked is not None:
        return (marked,)
    if len(head) > 1 and not head[1] and head[0]:
        return ("utf-16-le",)
    if len(head) > 1 and not head[0] and head[1]:
        return ("utf-16-be",)
    return ("utf-8", "cp1252")


def decode_text(data: bytes) -> str:
    r"""Decode text in UTF-8, or in UTF-16 or UTF-32 with a byte order mark; omit the mark.

    Parameters
    ----------
    data : bytes
        Contents of a file.

    Raises
    ------
    UnicodeDecodeError
        If the data are in another encoding.

    Examples
    --------
    >>> from rigd.text_table import decode_text
    >>> decode_text(b"\xef\xbb\xbfname = 1")
    'name = 1'
    """
    return data.decode(_marked(data[:_LONGEST_MARK]) or "utf-8")


def _marked(head: bytes) -> str | None:
    """Return the encoding of a byte order mark, None without a mark."""
    return next((name for mark, name in _MARKS if head.startswith(mark)), None)
