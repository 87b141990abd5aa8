"""Recordings of Rerun, read with its own reader."""


def batches(path):
    """Record batches by entity, in the order in which they were written."""
    from rerun.chunk import RrdReader

    found = {}
    for chunk in RrdReader(path).stream():
        found.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    return found
