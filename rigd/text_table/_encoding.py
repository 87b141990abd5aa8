"""Encoding of a text file: by its byte order mark, else UTF-8, else Windows' own."""

import codecs
from typing import Final

_MARKS: Final = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),  # begins as UTF-16's mark does
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
_LONGEST_MARK: Final = 4


def encodings(head: bytes) -> tuple[str, ...]:
    """Return the encodings to try, the likeliest first, from the first bytes of a file.

    Without a mark a file that is not UTF-8 is taken for Windows-1252, which most programs write
    that know no UTF-8. Numbers have the same bytes in both; only titles and units could differ.
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
    r"""Decode text in UTF-8, or in UTF-16 or UTF-32 with a byte order mark, which is left out.

    Parameters
    ----------
    data : bytes
        Contents of a file.

    Raises
    ------
    UnicodeDecodeError
        If it is no such text.

    Examples
    --------
    >>> from rigd.text_table import decode_text
    >>> decode_text(b"\xef\xbb\xbfname = 1")
    'name = 1'
    """
    return data.decode(_marked(data[:_LONGEST_MARK]) or "utf-8")


def _marked(head: bytes) -> str | None:
    """Return the encoding that a byte order mark states, None without one."""
    return next((name for mark, name in _MARKS if head.startswith(mark)), None)
