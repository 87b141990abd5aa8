"""Settings that must stand before numpy is imported."""

import os

# Threads gain nothing on small matrices, and fight each other where tests run in parallel.
os.environ.update(
    dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"), "1")
)
