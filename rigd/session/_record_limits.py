"""Longest record: one limit for planning, recording, import, analysis, export and replay."""

from typing import Final

MAX_SAMPLES: Final = 2_400_000
"""Most samples of a record: 40 minutes at 1 kHz. Read into memory they take 0.27 GB, and an
analysis, which is to do with 1 GB, 0.29 kB a sample beside 0.16 GB (0.53 GB for 1.27 million)."""
