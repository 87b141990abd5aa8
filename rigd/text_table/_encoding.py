"""Encoding of a text file: from its byte order mark, else UTF-8, else Windows-1252."""

import codecs
from typing import Final

_BYTE_ORDER_MARKS: Final = (
    (codecs.BOM_UTF8, "utf-8-sig"),
    (codecs.BOM_UTF32_LE, "utf-32"),  # first, because the mark of UTF-16 is its prefix
    (codecs.BOM_UTF32_BE, "utf-32"),
    (codecs.BOM_UTF16_LE, "utf-16"),
    (codecs.BOM_UTF16_BE, "utf-16"),
)
"""Byte order marks and the encodings that they state."""
_MAX_MARK_BYTES: Final = 4
"""Number of bytes in the longest byte order mark."""


def possible_encodings(first_bytes: bytes) -> tuple[str, ...]:
    """Return the possible encodings of a file from its first bytes, the most probable first.

    Most programs that do not write UTF-8 write Windows-1252. Numbers have the same bytes in both
    encodings; only titles and units can differ.
    """
    stated_encoding = _encoding_of_mark(first_bytes)
    if stated_encoding is not None:
        return (stated_encoding,)
    if len(first_bytes) > 1 and not first_bytes[1] and first_bytes[0]:
        return ("utf-16-le",)
    if len(first_bytes) > 1 and not first_bytes[0] and first_bytes[1]:
        return ("utf-16-be",)
    return ("utf-8", "cp1252")


def decode_text(text_bytes: bytes) -> str:
    r"""Return text that is encoded in UTF-8, or in UTF-16 or UTF-32 with a byte order mark.

    The byte order mark is omitted.

    Parameters
    ----------
    text_bytes : bytes
        Content of a file.

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
    return text_bytes.decode(_encoding_of_mark(text_bytes[:_MAX_MARK_BYTES]) or "utf-8")


def _encoding_of_mark(first_bytes: bytes) -> str | None:
    """Return the encoding that a byte order mark states; None if there is no mark."""
    return next(
        (
            encoding_name
            for byte_order_mark, encoding_name in _BYTE_ORDER_MARKS
            if first_bytes.startswith(byte_order_mark)
        ),
        None,
    )
