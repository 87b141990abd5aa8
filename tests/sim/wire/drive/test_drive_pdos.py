"""PDOs as the dictionary maps them."""

import struct

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

# Index, sub-index, letter of struct: from the tables of CiA 301 and 402.
SENDABLE = [
    (0x1001, 0, "B"),
    (0x603F, 0, "H"),
    (0x6040, 0, "H"),
    (0x6041, 0, "H"),
    (0x6060, 0, "b"),
    (0x6061, 0, "b"),
    (0x6064, 0, "i"),
    (0x606C, 0, "i"),
    (0x6071, 0, "h"),
    (0x6072, 0, "H"),
    (0x6077, 0, "h"),
    (0x60B2, 0, "h"),
    (0x60E0, 0, "H"),
    (0x60E1, 0, "H"),
]
RECEIVABLE = [
    (0x6040, 0, "H"),
    (0x6060, 0, "b"),
    (0x6071, 0, "h"),
    (0x6072, 0, "H"),
    (0x60B2, 0, "h"),
    (0x60E0, 0, "H"),
    (0x60E1, 0, "H"),
]
MODEST = settings(
    max_examples=60,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def entry(index, sub, letter):
    return index << 16 | sub << 8 | 8 * struct.calcsize("<" + letter)


def fitting(objects):
    def bits(chosen):
        return sum(entry(*one) & 0xFF for one in chosen)

    chosen = st.lists(st.sampled_from(objects), min_size=1, max_size=8)
    return chosen.filter(lambda chosen: bits(chosen) <= 64)


@MODEST
@given(number=st.integers(1, 4), chosen=fitting(SENDABLE), data=st.data())
def test_a_tpdo_has_the_values_read_by_sdo(bench, number, chosen, data):
    bench.nmt(129)
    bench.node.angle_offset_counts = data.draw(st.integers(-(1 << 31), (1 << 31) - 1))
    bench.write(0x6071, 0, data.draw(st.integers(-32768, 32767)), 2)
    bench.map_pdo(number, "t", 1, *(entry(*one) for one in chosen))
    bench.nmt(1)
    bench.sent.clear()
    bench.node.receive(0x80, b"")
    frame = dict(bench.sent)[0x180 + 0x100 * (number - 1) + 5]
    expected = [bench.read(i, s, signed=letter.islower()) for i, s, letter in chosen]
    assert list(struct.unpack("<" + "".join(one[2] for one in chosen), frame)) == expected


@MODEST
@given(
    number=st.integers(1, 4),
    chosen=st.lists(st.sampled_from(RECEIVABLE), min_size=1, max_size=4, unique=True).filter(
        lambda chosen: sum(entry(*one) & 0xFF for one in chosen) <= 64
    ),
    delivery=st.sampled_from([0, 1, 7, 240, 254, 255]),
    data=st.data(),
)
def test_an_rpdo_stores_the_values_read_by_sdo(bench, number, chosen, delivery, data):
    bench.nmt(129)
    bench.map_pdo(number, "r", delivery, *(entry(*one) for one in chosen))
    bench.nmt(1)
    before = [bench.read(i, s, signed=letter.islower()) for i, s, letter in chosen]
    values = [
        data.draw(
            st.sampled_from([0, 10])
            if index == 0x6060
            else st.integers(-32768, 32767)
            if letter.islower()
            else st.integers(0, 65535)
        )
        for index, _, letter in chosen
    ]
    letters = "<" + "".join(one[2] for one in chosen)
    bench.node.receive(0x200 + 0x100 * (number - 1) + 5, struct.pack(letters, *values))

    def stored():
        return [bench.read(i, s, signed=letter.islower()) for i, s, letter in chosen]

    assert stored() == (before if delivery <= 240 else values)
    bench.node.receive(0x80, b"")
    assert stored() == values
    assert not bench.plant.enabled


def test_an_rpdo_value_out_of_range_is_ignored(bench):
    bench.map_pdo(1, "r", 255, 0x6060_0008, 0x6071_0010)
    bench.nmt(1)
    bench.node.receive(0x205, b"\x0a\x64\x00")
    bench.node.receive(0x205, b"\x08\x65\x00")  # mode 8 is not supported
    assert (bench.read(0x6061), bench.read(0x6071)) == (10, 101)


@pytest.mark.parametrize("every", [1, 2, 3, 240])
def test_a_tpdo_comes_with_every_nth_sync(bench, every):
    bench.map_pdo(2, "t", every, 0x6041_0010)
    bench.nmt(1)
    received = []
    for _ in range(2 * every):
        bench.sent.clear()
        bench.node.receive(0x80, b"")
        received.append(0x285 in dict(bench.sent))
    assert received == 2 * ([False] * (every - 1) + [True])


def test_a_tpdo_of_type_0_follows_the_sync_after_a_change(bench):
    bench.map_pdo(1, "t", 0, 0x6041_0010)
    bench.nmt(1)

    def received():
        bench.sent.clear()
        bench.node.receive(0x80, b"")
        return [data.hex() for can_id, data in bench.sent if can_id == 0x185]

    assert received() == ["5002"]
    assert received() == []
    bench.write(0x6040, 0, 6, 2)
    assert received() == ["3102"]


def test_an_event_tpdo_follows_changes_and_its_timer(bench):
    bench.write(0x1800, 1, 0x8000_0185, 4)
    assert bench.write(0x1800, 3, 50, 2) == 0  # 5 ms between two
    assert bench.write(0x1800, 5, 100, 2) == 0
    bench.map_pdo(1, "t", 255, 0x6041_0010)
    bench.nmt(1)
    bench.take()
    bench.wait(1)
    assert bench.take() == [(0x185, b"\x50\x02")]
    bench.write(0x6040, 0, 6, 2)
    bench.take()
    bench.wait(4)
    assert bench.take() == []
    bench.wait(1)
    assert bench.take() == [(0x185, b"\x31\x02")]
    bench.wait(99)
    assert bench.take() == []
    bench.wait(1)
    assert bench.take() == [(0x185, b"\x31\x02")]


def test_no_pdos_outside_of_operational(bench):
    bench.configure()
    bench.nmt(128)
    assert bench.sync() is None
    bench.rpdo(0x06, 0)
    bench.nmt(1)
    bench.sync()
    assert bench.state() == "switch on disabled"


def test_leaving_operational_drops_a_pending_pdo(bench):
    bench.configure()
    bench.rpdo(0x06, 0)
    bench.nmt(128)
    bench.nmt(1)
    bench.sync()
    assert bench.state() == "switch on disabled"


def test_the_last_pdo_before_a_sync_counts(running):
    for per_mille in (100, 200, 300):
        running.rpdo(0x0F, per_mille)
    assert running.sync()[2] == 300


def test_another_pdo_may_be_changed_during_operation(running):
    running.drive(300)
    running.rpdo(0x0F, 310)
    running.map_pdo(2, "t", 1, 0x606C_0020)
    assert running.sync()[2] == 310
    assert running.state() == "operation enabled"


def test_mapping_a_pdo_drops_its_pending_values(running):
    running.rpdo(0x0F, 300)
    running.map_pdo(1, "r", 1, 0x6071_0010)
    assert running.sync()[2] == 0
    running.node.receive(0x205, b"\x64\x00")
    assert running.sync()[2] == 100


@pytest.mark.parametrize(
    ("steps", "code"),
    [
        ([(0x1A01, 1, 0x5000_0010, 4)], 0x06020000),  # no such object
        ([(0x1A01, 1, 0x6041_0110, 4)], 0x06090011),  # no such sub-index
        ([(0x1A01, 1, 0x6041_0008, 4)], 0x06040041),  # half of it
        ([(0x1A01, 1, 0x1017_0010, 4)], 0x06040041),  # not to be mapped
        ([(0x1601, 1, 0x6041_0010, 4)], 0x06040041),  # not to be received
        ([(0x1A01, 0, 9, 1)], 0x06040042),
        ([(0x1A01, 0, 1, 1)], 0x06020000),  # count of what is not mapped
        (
            [(0x1A01, k, 0x6064_0020, 4) for k in (1, 2, 3)] + [(0x1A01, 0, 3, 1)],
            0x06040042,  # 96 bits
        ),
        (
            [(0x1A01, 1, 0x6041_0010, 4), (0x1A01, 0, 1, 1), (0x1A01, 1, 0x6061_0008, 4)],
            0x08000022,  # count is not 0
        ),
        ([(0x1801, 2, 241, 1)], 0x06090030),
        ([(0x1801, 2, 252, 1)], 0x06090030),  # on request only
        ([(0x1801, 1, 0x2000_0285, 4)], 0x06090030),  # 29 bits
        ([(0x1801, 1, 0x0000_0605, 4)], 0x06090030),  # the SDO's
        ([(0x1801, 1, 0x0000_0000, 4)], 0x06090030),
        ([(0x1801, 1, 0x285, 4), (0x1801, 1, 0x286, 4)], 0x08000022),  # moved while on
        ([(0x1801, 1, 0x285, 4), (0x1801, 3, 10, 2)], 0x08000022),
    ],
)
def test_refused_mappings(bench, steps, code):
    *before, last = steps
    for step in before:
        assert bench.write(*step) == 0
    assert bench.write(*last) == code
