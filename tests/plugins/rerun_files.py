"""Recordings of Rerun, read with its own reader."""


def batches(path):
    """Record batches by entity, in order of time."""
    from rerun.chunk import RrdReader

    found = {}
    for chunk in RrdReader(path).stream():
        found.setdefault(chunk.entity_path, []).append(chunk.to_record_batch())
    return found
