"""Limits of session files: most data that is recorded, read, recovered and analysed.

Memory and time of a reader are proportional to the claims of a file, so every claim is bounded.
"""

from typing import Final

MAX_SAMPLES: Final = 2_400_000
"""Most samples of a record: 40 minutes at 1 kHz, for planning, recording, import, analysis, export
and replay. In memory they take 0.27 GB. An analysis, which is limited to 1 GB, takes 0.29 kB a
sample and 0.16 GB (0.53 GB for 1.27 million)."""
MAX_SURVEYED: Final = 7_200_000
"""Most samples of which only times, ticks and flags are read: two hours at 1 kHz, the longest
recording of an earlier version."""

MAX_FILE_BYTES: Final = 2 << 30
MAX_CHUNK_BYTES: Final = 256 << 20
MAX_TOTAL_BYTES: Final = 2 << 30
"""Most bytes of all chunks, unpacked: two hours and a half at 1 kHz."""
MAX_DECLARED_BYTES: Final = 64 << 20
"""Most memory for schemas, channels, metadata and attachments together."""
MAX_TEXT_BYTES: Final = 32 << 20
"""Most of that for all but the attachments: as text it takes up to four times as much memory."""
MAX_ENTRIES: Final = 100_000
"""Most keys in all metadata."""
MAX_MESSAGE_BYTES: Final = 16 << 20
"""Longest message that is read."""
MAX_STEPS: Final = 6_000_000
"""Most work on a file, in units of a run of messages: about a microsecond."""

MAX_SCHEMA_BYTES: Final = 1 << 17
"""Longest schema that is interpreted; those of this package take some hundred bytes."""
MAX_CHANNELS: Final = 16
"""Most channels of a topic."""
MAX_DECODED_BYTES: Final = 1 << 14
"""Longest message of numbers that is decoded; the fixed layout takes 119."""
MAX_SINGLE_MESSAGES: Final = 200_000
"""Most messages of a topic that are decoded one by one, at some 20 µs each."""
