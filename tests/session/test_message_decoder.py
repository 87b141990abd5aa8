"""Messages of any encoding: decoded together as protobuf decodes each of them."""

import numpy as np
import pytest
from google.protobuf.descriptor_pb2 import FileDescriptorSet
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from session_schemas import message_class, schemas

from rigd.session import SessionError, limits, read_session
from rigd.session.layout import SAMPLE_FIELDS

TYPES = {"INT64": 3, "UINT32": 13, "SINT32": 17, "FLOAT": 2, "SFIXED64": 16, "FIXED32": 7}


def schema_with(changes):
    files = FileDescriptorSet.FromString(schemas()["rigd.Sample"])
    for name, kind in changes.items():
        files.file[0].message_type[0].field[SAMPLE_FIELDS.index(name)].type = TYPES[kind]
    return files.SerializeToString()


@settings(
    max_examples=10,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(
    changes=st.fixed_dictionaries(
        {},
        optional={
            "t_ns": st.sampled_from(["INT64", "UINT32"]),
            "tick": st.sampled_from(["UINT32"]),
            "status": st.sampled_from(["UINT32", "SINT32"]),
            "fx_n": st.just("FLOAT"),
        },
    ),
    order=st.permutations(range(4)),
    tail=st.sampled_from([b"", b"\xa0\x01\x07", b"\xa2\x01\x03abc", b"\xa5\x01abcd"]),
    seed=st.integers(0, 99),
)
def test_any_encoding_is_read_as_by_protobuf(kit, tmp_path, changes, order, tail, seed):
    """Fields left out at zero, in another order, twice, unknown, or as numbers of any length."""
    rng = np.random.default_rng(seed)
    samples = kit.make_samples(400)
    samples["fx_n"] = np.round(rng.normal(size=400)) * (rng.random(400) < 0.5)
    samples["status"] = rng.integers(0, 400, 400) * (rng.random(400) < 0.3)
    schema = schema_with(changes)
    cls = message_class("rigd.Sample", schema)
    quarters = [SAMPLE_FIELDS[i::4] for i in order]
    messages = []
    for i, row in enumerate(samples):
        parts = [
            cls(**{name: row[name].item() for name in names}).SerializeToString()
            for names in quarters
        ]
        messages.append(b"".join(parts) + parts[i % 2] + tail)  # some fields twice
    decoded = [cls.FromString(message) for message in messages]
    # All of them, and few enough to be decoded one by one.
    for name, count in (("all.mcap", 400), ("few.mcap", 9)):
        path = kit.write_third_party(tmp_path / name, messages[:count], schema=schema)
        found = read_session(path).samples
        assert found.tolist() == [
            tuple(getattr(each, name) for name in SAMPLE_FIELDS) for each in decoded[:count]
        ]
        np.testing.assert_array_equal(found["tick"], np.arange(count))


def test_samples_of_another_order_are_decoded_together(kit, tmp_path, monkeypatch):
    samples = kit.make_samples(5000)
    messages = [m[9:14] + m[:9] + m[14:] for m in kit.fixed_messages(samples)]
    path = kit.write_third_party(tmp_path / "f.mcap", messages)
    monkeypatch.setattr(limits, "MAX_SINGLY_DECODED_MESSAGES", 0)
    np.testing.assert_array_equal(read_session(path).samples, samples)


def test_too_many_differing_messages_are_refused(kit, tmp_path, monkeypatch):
    monkeypatch.setattr(limits, "MAX_SINGLY_DECODED_MESSAGES", 100)
    whole = kit.fixed_messages(kit.make_samples(300))
    messages = [m + b"\xa2\x01" + bytes([i % 100]) + bytes(i % 100) for i, m in enumerate(whole)]
    path = kit.write_third_party(tmp_path / "f.mcap", messages)
    with pytest.raises(SessionError, match="more than 100 messages of /rig/sample differ so much"):
        read_session(path)


def test_a_truncated_message_is_found_among_equal_ones(kit, tmp_path):
    messages = [m[9:14] + m[:9] + m[14:] for m in kit.fixed_messages(kit.make_samples(100))]
    messages[50] = messages[50][:-1] + b"\x80"  # still a number
    messages[60] = b"\xff" * len(messages[60])
    path = kit.write_third_party(tmp_path / "f.mcap", messages)
    with pytest.raises(SessionError, match="not what its schema says"):
        read_session(path)
