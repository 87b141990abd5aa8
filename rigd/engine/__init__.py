"""The control process and the recorder process, and the shared memory between them."""
