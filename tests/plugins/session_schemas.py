"""Schemas of a session file as its writer states them, and protobuf's own classes for them."""

import tempfile
from functools import cache
from pathlib import Path

from google.protobuf.descriptor_pb2 import FileDescriptorSet
from google.protobuf.descriptor_pool import DescriptorPool
from google.protobuf.message_factory import GetMessageClass
from mcap.reader import make_reader

from rigd.session import SessionWriter


@cache
def schemas():
    """Return the schemas of a session file by name, as serialised ``FileDescriptorSet``."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "a.mcap"
        writer = SessionWriter(path)
        writer.begin(0, {}, {}, {})
        writer.close({"outcome": "complete"})
        with path.open("rb") as stream:
            return {
                each.name: each.data for each in make_reader(stream).get_summary().schemas.values()
            }


def message_class(name, data=None):
    """Return protobuf's class of a message, by this program's schema or another one."""
    pool = DescriptorPool()
    for file in FileDescriptorSet.FromString(data or schemas()[name]).file:
        pool.Add(file)
    return GetMessageClass(pool.FindMessageTypeByName(name))
