"""Make the record that the tutorials analyse: a session of the simulated rig, in 3 MB.

Usage: python docs/tutorials/make_record.py [NEW_FILE]

A session file of the rig has everything that the loop knew, in 14 MB. This one has the samples that
an analysis reads (reference, angle, torque), well compressed, and the session's metadata.
"""

import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer

from rigd.session import read_session
from rigd.session.layout import SAMPLE_SIZE, encode_samples

RECORD = Path(__file__).with_name("antenna.mcap")
SESSION = (
    *("rigd", "run", "chirp", "--profile", "sim", "--fast", "--seed", "1", "--no-look"),
    *("--output", ".", "--operator", "tutorial", "--specimen", "antenna 3"),
)
REFERENCE_STEP_RAD = 2.0**-20
"""The reference is rounded to a microradian, a seventieth of the encoder's step, to compress."""
OF_THE_COMPUTER = ("host", "software_commit")
"""Metadata about the computer on which the file is made."""


def make_record(path: Path) -> None:
    """Run the session and write its small copy to a new file."""
    with tempfile.TemporaryDirectory() as folder:
        subprocess.run(
            [sys.executable, "-m", *SESSION], cwd=folder, check=True, stdout=subprocess.DEVNULL
        )
        (session,) = Path(folder).glob("*.mcap")
        copy_small(session, path)


def copy_small(session: Path, path: Path) -> None:
    """Copy what an analysis reads of a session file to a new file."""
    samples = read_session(session).samples
    columns = {
        name: samples[name]
        for name in ("t_ns", "tick", "angle_rad", "coupling_torque_nm", "status")
    }
    columns["angle_reference_rad"] = REFERENCE_STEP_RAD * np.round(
        samples["angle_reference_rad"] / REFERENCE_STEP_RAD
    )
    messages = memoryview(encode_samples(columns)).cast("B")
    with session.open("rb") as source, path.open("xb") as stream:
        reader = make_reader(source)
        summary = reader.get_summary()
        assert summary is not None  # files of the rig have one
        topic = next(each for each in summary.channels.values() if each.topic == "/rig/sample")
        schema = summary.schemas[topic.schema_id]
        # Indexes of messages would be half of the file; readers do without.
        writer = Writer(
            stream,
            chunk_size=2**22,
            compression=CompressionType.ZSTD,
            index_types=IndexType.CHUNK | IndexType.METADATA,
        )
        writer.start(library="rigd")
        channel = writer.register_channel(
            topic.topic,
            topic.message_encoding,
            writer.register_schema(schema.name, schema.encoding, schema.data),
        )
        metadata = {each.name: dict(each.metadata) for each in reader.iter_metadata()}
        start_ns = int(metadata["session"]["start_utc_ns"])
        for index, t_ns in enumerate(samples["t_ns"].tolist()):
            message = bytes(messages[index * SAMPLE_SIZE : (index + 1) * SAMPLE_SIZE])
            writer.add_message(channel, start_ns + t_ns, message, 0)
        for name, content in metadata.items():
            for key in OF_THE_COMPUTER:
                content.pop(key, None)
            writer.add_metadata(name, content)
        writer.finish()


if __name__ == "__main__":
    make_record(Path(sys.argv[1]) if len(sys.argv) > 1 else RECORD)
