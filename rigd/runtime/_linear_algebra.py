"""Threads of the linear algebra: none but the caller's."""

import os
from typing import Final

SINGLE_THREADED: Final = dict.fromkeys(
    ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1"
)
"""Environment in which numpy starts no threads."""


def use_one_thread() -> None:
    """Let numpy start no threads, in this process and in those that it starts.

    They gain nothing on matrices as small as ours, and cost a tenth of a fit's time. With a
    real-time priority they do harm: the threads of one calculation, all kept off the loop's core,
    wait for each other by turning in a circle, so that what takes a second took a minute and
    nothing else ran on that core.

    numpy looks at the environment once, when it is imported: this has to come before.
    """
    os.environ.update(SINGLE_THREADED)
