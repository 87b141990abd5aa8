"""Limits of session files: maximum amounts of data that are recorded, read and analysed.

A reader's memory and time grow with the sizes and counts that a file states, so each is limited.
"""

from typing import Final

MAX_SAMPLES: Final = 4_000_000
"""Maximum number of samples that are imported, exported or replayed, or analysed in one fit: an
hour at 1 kHz, with rest and ring-down. The samples take 0.45 GB of memory. An analysis, which
decimates a long record while it is read, takes 0.65 GB with the default band."""
MAX_RECORDED_SAMPLES: Final = 40_000_000
"""Maximum number of samples of a file, of which all are recorded, described and recovered, and
blocks or parts are analysed: eleven hours at 1 kHz."""

MAX_FILE_BYTES: Final = 8 << 30
"""Maximum length of a session file in bytes."""
MAX_CHUNK_BYTES: Final = 256 << 20
"""Maximum length of a decompressed chunk in bytes."""
MAX_TOTAL_UNPACKED_BYTES: Final = 8 << 30
"""Maximum length of all decompressed chunks of a file in bytes: 14 hours at 1 kHz."""
MAX_DECLARATION_BYTES: Final = 64 << 20
"""Maximum memory in bytes for schemas, channels, metadata and attachments of a file together."""
MAX_DECLARATION_TEXT_BYTES: Final = 32 << 20
"""Maximum length in bytes of schemas, channels and metadata of a file together. Their texts take up
to four times as much memory."""
MAX_METADATA_KEYS: Final = 100_000
"""Maximum number of keys in all metadata of a file."""
MAX_MESSAGE_BYTES: Final = 16 << 20
"""Maximum length of a message in bytes."""
MAX_READING_STEPS: Final = 6_000_000
"""Maximum work for reading a file, in steps of about a microsecond; a run of messages is a step."""

MAX_SCHEMA_BYTES: Final = 1 << 17
"""Maximum length in bytes of a schema that is parsed; a schema of this package takes some hundred
bytes."""
MAX_CHANNELS_PER_TOPIC: Final = 16
"""Maximum number of channels of one topic."""
MAX_SAMPLE_MESSAGE_BYTES: Final = 1 << 14
"""Maximum length in bytes of a sample message that is decoded; the fixed layout takes 119 bytes."""
MAX_SINGLY_DECODED_MESSAGES: Final = 200_000
"""Maximum number of messages of a topic that are decoded one by one, which takes 20 µs each."""
