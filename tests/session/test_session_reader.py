"""Reader of sound files of this writer and of any other MCAP and protobuf library."""

import dataclasses
import gc
import weakref

import numpy as np
import pytest
import zstandard
from google.protobuf import message_factory
from google.protobuf.descriptor_pb2 import FieldDescriptorProto, FileDescriptorSet
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType, IndexType, Writer
from session_schemas import message_class, schemas

from rigd.session import SessionError, read_controls, read_session
from rigd.session.layout import SAMPLE_FIELD_TYPES, SAMPLE_FIELDS, decode_controls


def encoded(samples, cls=None):
    """Messages as google.protobuf writes them: zeros left out."""
    cls = cls or message_class("rigd.Sample")
    return [
        cls(**dict(zip(SAMPLE_FIELDS, row, strict=True))).SerializeToString()
        for row in samples.tolist()
    ]


def changed_schema(change):
    """Return the sample's schema with `change` applied to its message descriptor."""
    files = FileDescriptorSet.FromString(schemas()["rigd.Sample"])
    change(files.file[0].message_type[0])
    return files.SerializeToString()


def test_a_recorded_session_is_read_back(kit, recorded):
    session = read_session(recorded.path)
    assert session.path == recorded.path
    np.testing.assert_array_equal(session.samples, recorded.samples)
    np.testing.assert_array_equal(
        read_controls(recorded.path), decode_controls(recorded.controls)
    )  # fmt: skip
    assert session.start_utc_ns == kit.START_UTC_NS
    assert kit.METADATA.items() <= session.metadata.items()
    assert session.segments == kit.SEGMENTS
    assert session.outcome == kit.OUTCOME
    assert session.attachments == kit.ATTACHMENTS
    assert [dataclasses.astuple(event) for event in session.events] == [
        (-5_000_000, "info", "rigd.engine", "before the first tick"),
        (1_000_000_000, "warning", "rigd", "late — 3 ticks"),
    ]
    assert session.number("beam_length_m") == 0.98
    assert session.number("angle_delay_s", 0.0) == 0.0


def test_the_samples_of_a_session_are_freed_with_it(recorded):
    # Without the collector of cycles, which starts late in a process of few objects.
    gc.disable()
    try:
        session = read_session(recorded.path)
        samples = weakref.ref(session.samples)
        del session
        assert samples() is None
    finally:
        gc.enable()


def test_samples_passed_on_are_not_stored(recorded):
    blocks = []
    session = read_session(recorded.path, on_samples=lambda block: blocks.append(block.copy()))
    assert session == dataclasses.replace(read_session(recorded.path), samples=session.samples)
    assert len(session.samples) == 0
    np.testing.assert_array_equal(np.concatenate(blocks), recorded.samples)


def test_part_has_its_chunks_and_those_of_the_rest(paper_file):
    whole = read_session(paper_file)
    part = read_session(paper_file, part_s=(60.0, 70.0))
    assert dataclasses.replace(part, samples=whole.samples) == whole
    ticks = part.samples["tick"]
    assert {*range(1000), *range(60_000, 70_000)} <= set(ticks.tolist())
    assert len(ticks) < 22_000
    np.testing.assert_array_equal(part.samples, whole.samples[ticks])


def test_chunks_outside_a_part_are_not_checked(paper_file, tmp_path):
    with paper_file.open("rb") as file:
        chunks = make_reader(file).get_summary().chunk_indexes
    content = bytearray(paper_file.read_bytes())
    content[chunks[len(chunks) // 2].chunk_start_offset + 200] ^= 1  # at 68 s
    damaged = tmp_path / "damaged.mcap"
    damaged.write_bytes(content)
    for part_s in (None, (60.0, 70.0)):
        with pytest.raises(SessionError, match="is damaged"):
            read_session(damaged, part_s=part_s)
    assert len(read_session(damaged, part_s=(100.0, 110.0)).samples) > 10_000


def test_file_without_a_usable_rate_is_read_as_a_whole(write_session, short_signals, tmp_path):
    path = write_session(tmp_path / "a.mcap", short_signals, metadata={"rate_hz": "often"})
    assert len(read_session(path, part_s=(4.9, 5.0)).samples) == 5000


def test_many_small_chunks_use_one_decompressor(kit, tmp_path, monkeypatch):
    """Making one takes 28 µs, a small chunk one: a file of them would take seven times as long."""
    made = []
    original = zstandard.ZstdDecompressor

    def counted(**options):
        made.append(options)
        return original(**options)

    messages = kit.fixed_messages(kit.make_samples(50))
    path = kit.write_third_party(
        tmp_path / "a.mcap", messages, chunk_size=1, compression=CompressionType.ZSTD
    )
    assert len(kit.chunks_of(path)) == 50
    monkeypatch.setattr(zstandard, "ZstdDecompressor", counted)
    assert len(read_session(path).samples) == 50
    assert len(made) < 5


@pytest.mark.parametrize("compression", list(CompressionType))
@pytest.mark.parametrize("extra", [None, "/other"])
@pytest.mark.parametrize(
    "options",
    [
        {"chunk_size": 1},
        {"chunk_size": 5000},
        {"enable_data_crcs": True},
        {"enable_crcs": False},
        {"use_chunking": False},
        {
            "repeat_channels": False,
            "repeat_schemas": False,
            "use_statistics": False,
            "use_summary_offsets": False,
            "index_types": IndexType.NONE,
        },
    ],
    ids=lambda options: next(iter(options)),
)
def test_any_container_is_read(kit, tmp_path, compression, extra, options):
    samples = kit.make_samples(333)
    path = kit.write_third_party(
        tmp_path / "f.mcap",
        kit.fixed_messages(samples),
        compression=compression,
        extra=extra,
        **options,
    )
    session = read_session(path)
    np.testing.assert_array_equal(session.samples, samples)
    assert session.metadata == kit.MINIMUM
    assert session.start_utc_ns == 77
    assert (session.segments, session.outcome, session.events) == ({}, None, [])
    assert len(read_controls(path)) == 0


@settings(
    max_examples=30,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)
@given(st.lists(st.booleans(), min_size=1, max_size=40), st.integers(1, 3000), st.booleans())
def test_fixed_and_other_encodings_mix_in_any_order(kit, tmp_path, kinds, chunk_size, extra):
    samples = kit.make_samples(len(kinds))
    samples["status"] = 0  # which the other encoder leaves out
    samples["fx_n"][::2] = 0.0
    pairs = zip(kinds, kit.fixed_messages(samples), encoded(samples), strict=True)
    path = kit.write_third_party(
        tmp_path / "f.mcap",
        [fixed if kind else other for kind, fixed, other in pairs],
        chunk_size=chunk_size,
        extra="/other" if extra else None,
    )
    np.testing.assert_array_equal(read_session(path).samples, samples)


def test_a_schema_is_interpreted_once_for_varying_messages(kit, tmp_path, monkeypatch):
    """Zeros left out make lengths differ, so that hardly two messages are taken together."""
    samples = kit.make_samples(300)
    samples["fx_n"][::2] = 0.0
    # A schema of its own, which nothing has read before.
    schema = changed_schema(lambda message: message.field.add(name="once", number=99, type=9))
    path = kit.write_third_party(tmp_path / "f.mcap", encoded(samples), schema=schema)
    built = []
    get_class = message_factory.GetMessageClass
    monkeypatch.setattr(
        message_factory, "GetMessageClass", lambda d: built.append(d) or get_class(d)
    )
    np.testing.assert_array_equal(read_session(path).samples, samples)
    assert len(built) == 1


def test_fields_in_another_order_and_unknown_ones_are_decoded(kit, tmp_path):
    samples = kit.make_samples(20)
    messages = []
    for message in kit.fixed_messages(samples):
        # Fields 1 and 2 exchanged, at unchanged length; then an unknown field 20.
        messages += [message[9:14] + message[:9] + message[14:] + b"\xa0\x01\x07"]
    path = kit.write_third_party(tmp_path / "f.mcap", messages)
    np.testing.assert_array_equal(read_session(path).samples, samples)
    swapped = [m[:-3] for m in messages]
    path = kit.write_third_party(tmp_path / "g.mcap", swapped)
    np.testing.assert_array_equal(read_session(path).samples, samples)


def test_samples_of_the_fixed_length_follow_their_own_schema(kit, tmp_path):
    """The bytes are those of the fixed layout, but two fields have exchanged their names."""

    def swap(message):
        message.field[3].name, message.field[5].name = message.field[5].name, message.field[3].name

    samples = kit.make_samples(20)
    path = kit.write_third_party(
        tmp_path / "f.mcap", kit.fixed_messages(samples), schema=changed_schema(swap)
    )  # fmt: skip
    read = read_session(path).samples
    np.testing.assert_array_equal(read["angle_rad"], samples["coupling_torque_nm"])
    np.testing.assert_array_equal(read["coupling_torque_nm"], samples["angle_rad"])


def test_other_numbers_types_names_and_files_are_decoded(kit, tmp_path):
    def change(message):
        message.name = "Probe"
        types = {"t_ns": "INT64", "tick": "UINT64", "angle_rad": "FLOAT", "status": "SINT32"}
        for field in message.field:
            field.number += 40
            if field.name in types:
                field.type = getattr(FieldDescriptorProto, f"TYPE_{types[field.name]}")
        del message.field[6:12]  # no wrench
        message.field.add(name="note", number=3, type=9, label=1)

    schema = changed_schema(change)
    cls = message_class("rigd.Probe", schema)
    samples = kit.make_samples(30)
    samples["angle_rad"] = samples["angle_rad"].astype(np.float32)
    for name in SAMPLE_FIELDS[6:12]:
        samples[name] = 0.0
    names = [name for name in SAMPLE_FIELDS if name not in SAMPLE_FIELDS[6:12]]
    messages = [
        cls(note="x", **{name: sample[name].item() for name in names}).SerializeToString()
        for sample in samples
    ]
    path = kit.write_third_party(tmp_path / "f.mcap", messages, schema=schema, name="rigd.Probe")
    np.testing.assert_array_equal(read_session(path).samples, samples)


@pytest.mark.parametrize("field", ["t_ns", "tick", "angle_rad", "coupling_torque_nm"])
def test_a_schema_without_a_required_field_is_refused(kit, tmp_path, field):
    def change(message):
        del message.field[SAMPLE_FIELDS.index(field)]

    path = kit.write_third_party(tmp_path / "f.mcap", [b""], schema=changed_schema(change))
    with pytest.raises(SessionError, match=rf"f\.mcap: the schema .* no field {field}"):
        read_session(path)


@pytest.mark.parametrize(
    ("field", "kind", "label"), [("tick", 1, 1), ("angle_rad", 9, 1), ("fx_n", 1, 3)]
)
def test_a_schema_with_unreadable_types_is_refused(kit, tmp_path, field, kind, label):
    def change(message):
        message.field[SAMPLE_FIELDS.index(field)].type = kind
        message.field[SAMPLE_FIELDS.index(field)].label = label

    path = kit.write_third_party(tmp_path / "f.mcap", [b""], schema=changed_schema(change))
    with pytest.raises(SessionError, match=rf"field {field} .*{SAMPLE_FIELD_TYPES[field]}"):
        read_session(path)


def test_a_number_too_large_for_its_field_is_refused(kit, tmp_path):
    def change(message):
        message.field[SAMPLE_FIELDS.index("tick")].type = FieldDescriptorProto.TYPE_UINT64

    schema = changed_schema(change)
    message = message_class("rigd.Sample", schema)(tick=2**32).SerializeToString()
    path = kit.write_third_party(tmp_path / "f.mcap", [message], schema=schema)
    with pytest.raises(SessionError, match="holds a number that its field cannot take"):
        read_session(path)


def test_an_event_log_without_protobuf_is_omitted(kit, tmp_path):
    path = kit.write_third_party(
        tmp_path / "f.mcap", kit.fixed_messages(kit.make_samples(3)), extra="/rig/event"
    )
    assert read_session(path).events == []


@pytest.mark.parametrize("ticks", [[0, 1, 1], [0, 2, 1], [5, 4, 3]])
def test_non_increasing_ticks_are_refused(kit, tmp_path, ticks):
    samples = kit.make_samples(3)
    samples["tick"] = ticks
    path = kit.write_third_party(tmp_path / "f.mcap", kit.fixed_messages(samples))
    with pytest.raises(SessionError, match=r"f\.mcap: tick \d follows tick \d"):
        read_session(path)


def test_gaps_in_the_ticks_are_read(kit, tmp_path):
    samples = kit.make_samples(10)[[0, 1, 5, 9]]
    path = kit.write_third_party(tmp_path / "f.mcap", kit.fixed_messages(samples))
    assert read_session(path).samples["tick"].tolist() == [0, 1, 5, 9]


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (None, "has no rate_hz.*number in Hz"),
        ("fast", "rate_hz .* is 'fast', .*number in Hz"),
        ("nan", "'nan', which is not a finite"),
        ("inf", "'inf', which is not a finite"),
        ("", "'', which is not a finite"),
        ("9" * 5000, "not a finite"),
    ],
)
def test_a_bad_number_in_the_metadata_is_named(kit, tmp_path, value, message):
    metadata = dict(kit.MINIMUM)
    del metadata["rate_hz"]
    if value is not None:
        metadata["rate_hz"] = value
    path = kit.write_third_party(
        tmp_path / "f.mcap", kit.fixed_messages(kit.make_samples(2)), metadata=metadata
    )
    session = read_session(path)
    with pytest.raises(SessionError, match=r"f\.mcap: .*" + message) as error:
        session.number("rate_hz")
    assert len(str(error.value)) < 400


@pytest.mark.parametrize(
    ("metadata", "message"),
    [
        ({"format_version": "2"}, "version '2', and this program reads version 1"),
        ({"start_utc_ns": "yesterday"}, "start_utc_ns .* 'yesterday'"),
        ({"start_utc_ns": "-1"}, "start_utc_ns"),
    ],
)
def test_other_bad_metadata_is_named(kit, tmp_path, metadata, message):
    path = kit.write_third_party(
        tmp_path / "f.mcap", kit.fixed_messages(kit.make_samples(2)), metadata=metadata
    )
    with pytest.raises(SessionError, match=message):
        read_session(path)


@pytest.mark.parametrize("text", ["", "1", "1,2,3", "a,b", "-1,5", "7,3", "1.5,3", "1" * 50 + ",2"])
def test_a_bad_segment_is_named(tmp_path, text):
    path = tmp_path / "f.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        writer.add_metadata("segments", {"sweep": text})
        schema = writer.register_schema("rigd.Sample", "protobuf", schemas()["rigd.Sample"])
        writer.register_channel("/rig/sample", "protobuf", schema)
        writer.finish()
    with pytest.raises(SessionError, match="segment 'sweep'"):
        read_session(path)
