"""Every message of the drive, written out by hand from CiA 301 and 402."""

import pytest


def frames(bench):
    return [f"{can_id:03X} {data.hex(' ')}".strip() for can_id, data in bench.take()]


def test_boot_up_message_and_pre_operational_state(rig, make_bench):
    bench = make_bench()
    bench.nmt(129)
    assert frames(bench) == ["705 00"]
    assert bench.nmt_state() == "pre-operational"


@pytest.mark.parametrize("first", ["tick", "frame"])
def test_boot_up_in_the_first_call(make_bench, first):
    bench = make_bench(booted=False)
    assert bench.take() == []
    if first == "tick":
        bench.node.tick(0.0)
    else:
        bench.node.receive(0x605, bytes.fromhex("40 00 10 00 00 00 00 00"))
    assert frames(bench)[0] == "705 00"


@pytest.mark.parametrize(
    ("index", "sub", "reply"),
    [
        (0x1000, 0, "43 00 10 00 92 01 02 00"),  # servo drive, CiA 402
        (0x1001, 0, "4f 01 10 00 00 00 00 00"),
        (0x1003, 0, "4f 03 10 00 00 00 00 00"),
        (0x1005, 0, "43 05 10 00 80 00 00 00"),
        (0x1006, 0, "43 06 10 00 00 00 00 00"),
        (0x1014, 0, "43 14 10 00 85 00 00 00"),
        (0x1016, 0, "4f 16 10 00 02 00 00 00"),
        (0x1016, 1, "43 16 10 01 00 00 00 00"),
        (0x1017, 0, "4b 17 10 00 00 00 00 00"),
        (0x1018, 0, "4f 18 10 00 04 00 00 00"),
        (0x1018, 1, "43 18 10 01 34 12 00 00"),
        (0x1018, 2, "43 18 10 02 78 56 00 00"),
        (0x1019, 0, "4f 19 10 00 00 00 00 00"),
        (0x1029, 1, "4f 29 10 01 00 00 00 00"),
        (0x1400, 1, "43 00 14 01 05 02 00 00"),
        (0x1400, 2, "4f 00 14 02 ff 00 00 00"),
        (0x1403, 1, "43 03 14 01 05 05 00 80"),
        (0x1600, 0, "4f 00 16 00 01 00 00 00"),
        (0x1600, 1, "43 00 16 01 10 00 40 60"),
        (0x1800, 1, "43 00 18 01 85 01 00 00"),
        (0x1803, 1, "43 03 18 01 85 04 00 80"),
        (0x1A00, 1, "43 00 1a 01 10 00 41 60"),
        (0x6007, 0, "4b 07 60 00 01 00 00 00"),
        (0x603F, 0, "4b 3f 60 00 00 00 00 00"),
        (0x6041, 0, "4b 41 60 00 50 02 00 00"),  # switch on disabled, voltage, remote
        (0x605A, 0, "4b 5a 60 00 02 00 00 00"),
        (0x605B, 0, "4b 5b 60 00 00 00 00 00"),
        (0x605C, 0, "4b 5c 60 00 00 00 00 00"),
        (0x605E, 0, "4b 5e 60 00 00 00 00 00"),
        (0x6060, 0, "4f 60 60 00 00 00 00 00"),
        (0x6061, 0, "4f 61 60 00 00 00 00 00"),
        (0x6064, 0, "43 64 60 00 00 00 00 00"),
        (0x606C, 0, "43 6c 60 00 00 00 00 00"),
        (0x6071, 0, "4b 71 60 00 00 00 00 00"),
        (0x6072, 0, "4b 72 60 00 08 07 00 00"),  # 0.9 N·m of 0.5 N·m: 1800
        (0x6076, 0, "43 76 60 00 f4 01 00 00"),  # 0.5 N·m / 100 in units of 1e-5 N·m: 500
        (0x6077, 0, "4b 77 60 00 00 00 00 00"),
        (0x6080, 0, "43 80 60 00 20 4e 00 00"),
        (0x60B2, 0, "4b b2 60 00 00 00 00 00"),
        (0x60C2, 1, "4f c2 60 01 01 00 00 00"),
        (0x60C2, 2, "4f c2 60 02 fd 00 00 00"),
        (0x60E0, 0, "4b e0 60 00 08 07 00 00"),
        (0x60E1, 0, "4b e1 60 00 08 07 00 00"),
        (0x6502, 0, "43 02 65 00 00 02 00 00"),  # cyclic synchronous torque alone
    ],
)
def test_the_dictionary_at_power_on(bench, index, sub, reply):
    assert bench.request(f"40 {index & 0xFF:02x} {index >> 8:02x} {sub:02x} 00 00 00 00") == reply


def test_an_expedited_download_of_each_size(bench):
    assert bench.request("2f 60 60 00 0a 00 00 00") == "60 60 60 00 00 00 00 00"
    assert bench.request("2b 17 10 00 14 00 00 00") == "60 17 10 00 00 00 00 00"
    assert bench.request("23 16 10 01 32 00 64 00") == "60 16 10 01 00 00 00 00"
    assert bench.request("22 06 10 00 e8 03 00 00") == "60 06 10 00 00 00 00 00"  # no size given
    assert bench.request("40 61 60 00 00 00 00 00") == "4f 61 60 00 0a 00 00 00"
    assert bench.request("40 06 10 00 00 00 00 00") == "43 06 10 00 e8 03 00 00"


def test_a_segmented_upload(bench):
    assert bench.request("40 08 10 00 00 00 00 00") == "41 08 10 00 15 00 00 00"
    assert bench.request("60 00 00 00 00 00 00 00") == "00 " + b"simulat".hex(" ")
    assert bench.request("70 00 00 00 00 00 00 00") == "10 " + b"ed serv".hex(" ")
    assert bench.request("60 00 00 00 00 00 00 00") == "01 " + b"o drive".hex(" ")
    assert bench.request("70 00 00 00 00 00 00 00") == "80 00 00 00 01 00 04 05"


def test_a_segmented_download_in_two_segments(bench):
    assert bench.request("21 06 10 00 04 00 00 00") == "60 06 10 00 00 00 00 00"
    assert bench.request("0a d0 07 00 00 00 00 00") == "20 00 00 00 00 00 00 00"  # 2 of 7 bytes
    assert bench.request("1b 00 00 00 00 00 00 00") == "30 00 00 00 00 00 00 00"  # 2 more, the last
    assert bench.read(0x1006) == 2000


@pytest.mark.parametrize("announced", [True, False])
@pytest.mark.parametrize("sizes", [(4,), (1, 3), (3, 1), (2, 2), (1, 1, 1, 1)])
def test_a_download_in_segments_of_any_size(bench, sizes, announced):
    value = bytes.fromhex("01020304")
    head = "21 06 10 00 04 00 00 00" if announced else "20 06 10 00 00 00 00 00"
    assert bench.request(head) == "60 06 10 00 00 00 00 00"
    toggle = 0
    for number, size in enumerate(sizes, 1):
        command = toggle | (7 - size) << 1 | (number == len(sizes))
        part, value = value[:size], value[size:]
        reply = bench.request((bytes([command]) + part.ljust(7, b"\xee")).hex())
        assert reply == f"{0x20 | toggle:02x} 00 00 00 00 00 00 00"
        toggle ^= 0x10
    assert bench.read(0x1006) == 0x04030201


def test_a_new_transfer_replaces_an_unfinished_one(bench):
    bench.request("20 06 10 00 00 00 00 00")
    bench.request("0a aa aa 00 00 00 00 00")
    assert bench.request("40 08 10 00 00 00 00 00") == "41 08 10 00 15 00 00 00"
    assert bench.request("60 00 00 00 00 00 00 00") == "00 " + b"simulat".hex(" ")
    assert bench.read(0x1006) == 0
    assert bench.write(0x1006, 0, 2, 4) == 0
    assert bench.read(0x1006) == 2


@pytest.mark.parametrize(
    ("request_", "reply"),
    [
        ("40 00 30 00 00 00 00 00", "80 00 30 00 00 00 02 06"),  # no object
        ("40 18 10 09 00 00 00 00", "80 18 10 09 11 00 09 06"),  # no sub-index
        ("40 00 14 04 00 00 00 00", "80 00 14 04 11 00 09 06"),
        ("23 00 10 00 00 00 00 00", "80 00 10 00 02 00 01 06"),  # read only
        ("2b 41 60 00 00 00 00 00", "80 41 60 00 02 00 01 06"),
        ("2f 17 10 00 14 00 00 00", "80 17 10 00 10 00 07 06"),  # one byte for two
        ("21 17 10 00 03 00 00 00", "80 17 10 00 10 00 07 06"),  # segmented, three for two
        ("2f 60 60 00 08 00 00 00", "80 60 60 00 30 00 09 06"),  # a mode it has not
        ("2b 07 60 00 04 00 00 00", "80 07 60 00 30 00 09 06"),
        ("2b 07 60 00 ff ff 00 00", "80 07 60 00 30 00 09 06"),
        ("2b 5a 60 00 03 00 00 00", "80 5a 60 00 30 00 09 06"),
        ("2f 29 10 01 03 00 00 00", "80 29 10 01 30 00 09 06"),
        ("23 05 10 00 80 00 00 40", "80 05 10 00 30 00 09 06"),  # SYNC producer
        ("2f 03 10 00 01 00 00 00", "80 03 10 00 30 00 09 06"),
        ("40 03 10 01 00 00 00 00", "80 03 10 01 24 00 00 08"),  # no error yet
        ("23 00 16 01 10 00 71 60", "80 00 16 01 22 00 00 08"),  # mapping of a PDO that is on
        ("2f 00 16 00 00 00 00 00", "80 00 16 00 22 00 00 08"),
        ("a0 08 10 00 7f 00 00 00", "80 08 10 00 01 00 04 05"),  # block upload
        ("c2 08 10 00 00 00 00 00", "80 08 10 00 01 00 04 05"),  # block download
        ("e0 00 00 00 00 00 00 00", "80 00 00 00 01 00 04 05"),
        ("60 00 00 00 00 00 00 00", "80 00 00 00 01 00 04 05"),  # a segment of nothing
        ("00 00 00 00 00 00 00 00", "80 00 00 00 01 00 04 05"),
    ],
)
def test_refused_transfers(bench, request_, reply):
    assert bench.request(request_) == reply


def test_a_wrong_toggle_bit_ends_the_transfer(bench):
    bench.request("40 08 10 00 00 00 00 00")
    bench.request("60 00 00 00 00 00 00 00")
    assert bench.request("60 00 00 00 00 00 00 00") == "80 08 10 00 00 00 03 05"
    assert bench.request("70 00 00 00 00 00 00 00") == "80 00 00 00 01 00 04 05"


def test_a_download_longer_than_the_object_ends(bench):
    bench.request("20 17 10 00 00 00 00 00")
    assert bench.request("00 01 02 03 04 05 06 07") == "80 17 10 00 10 00 07 06"
    assert bench.read(0x1017) == 0


def test_an_abort_by_the_client_gets_no_reply(bench):
    bench.request("40 08 10 00 00 00 00 00")
    bench.take()
    bench.node.receive(0x605, bytes.fromhex("80 08 10 00 00 00 04 05"))
    assert bench.take() == []
    assert bench.request("60 00 00 00 00 00 00 00").startswith("80")


def test_a_request_without_eight_bytes_is_ignored(bench):
    bench.node.receive(0x605, bytes.fromhex("40 00 10 00"))
    assert bench.take() == []


def test_the_cyclic_frames(bench):
    bench.configure()
    bench.take()
    for rpdo, tpdo in (
        ("06 00 00 00", "31 02 00 00 00 00 00 00"),
        ("07 00 00 00", "33 02 00 00 00 00 00 00"),
        ("0f 00 00 00", "37 12 00 00 00 00 00 00"),
        ("0f 00 64 00", "37 12 00 00 00 00 64 00"),  # 100 ‰
        ("0f 00 9c ff", None),  # −100 ‰
        ("0f 00 08 07", None),  # the most: 1800 ‰
        ("0f 00 09 07", None),  # and beyond
        ("0f 01 64 00", None),  # halt
    ):
        bench.node.receive(0x205, bytes.fromhex(rpdo))
        bench.node.receive(0x080, b"")
        ((can_id, data),) = bench.take()
        assert can_id == 0x185
        if tpdo:
            assert data.hex(" ") == tpdo
        else:
            word = data[:2].hex(" ")
            torque = data[6:].hex(" ")
            assert (word, torque) == {
                "0f 00 9c ff": ("37 12", "9c ff"),
                "0f 00 08 07": ("37 12", "08 07"),
                "0f 00 09 07": ("37 1a", "08 07"),  # bit 11: internal limit
                "0f 01 64 00": ("37 02", "00 00"),  # bit 12 gone: the target is ignored
            }[rpdo]


def test_the_heartbeat_in_each_nmt_state(bench):
    bench.request("2b 17 10 00 14 00 00 00")
    bench.take()
    bench.wait(40)
    assert frames(bench) == ["705 7f", "705 7f"]
    bench.nmt(1)
    bench.take()
    bench.wait(40)
    assert [frame for frame in frames(bench) if frame.startswith("7")] == ["705 05", "705 05"]
    bench.nmt(2)
    bench.take()
    bench.wait(40)
    assert frames(bench) == ["705 04", "705 04"]


def test_the_mean_period_of_heartbeats_is_independent_of_time_steps(bench):
    bench.write(0x1017, 0, 10, 2)
    bench.take()
    for step in range(300):
        bench.node.tick(3e-3 * step)
    assert len(bench.take()) in (90, 91)


def test_an_emergency_its_history_and_its_end(bench):
    bench.node.emergency(0x2310, 0x02, bytes.fromhex("0102030405"))
    assert frames(bench) == ["085 10 23 03 01 02 03 04 05"]
    assert bench.request("40 01 10 00 00 00 00 00") == "4f 01 10 00 03 00 00 00"
    assert bench.request("40 3f 60 00 00 00 00 00") == "4b 3f 60 00 10 23 00 00"
    assert bench.request("40 03 10 00 00 00 00 00") == "4f 03 10 00 01 00 00 00"
    assert bench.request("40 03 10 01 00 00 00 00") == "43 03 10 01 10 23 00 00"
    assert bench.request("40 41 60 00 00 00 00 00") == "4b 41 60 00 18 02 00 00"
    bench.take()
    bench.node.receive(0x605, bytes.fromhex("2b 40 60 00 80 00 00 00"))
    assert frames(bench) == ["085 00 00 00 00 00 00 00 00", "585 60 40 60 00 00 00 00 00"]
    assert bench.request("40 01 10 00 00 00 00 00") == "4f 01 10 00 00 00 00 00"
    assert bench.request("2f 03 10 00 00 00 00 00") == "60 03 10 00 00 00 00 00"
    assert bench.request("40 03 10 00 00 00 00 00") == "4f 03 10 00 00 00 00 00"


def test_the_history_has_the_last_eight_newest_first(bench):
    for code in range(0xFF00, 0xFF0A):
        bench.node.emergency(code, 0x80, b"")
    assert bench.read(0x1003) == 8
    assert [bench.read(0x1003, sub) for sub in (1, 2, 8)] == [0xFF09, 0xFF08, 0xFF02]


def test_nmt_commands_for_others_and_wrong_lengths_are_ignored(bench):
    for data in (b"\x01\x06", b"\x01", b"\x01\x05\x00", b"\x55\x05", b""):
        bench.node.receive(0, data)
        assert bench.nmt_state() == "pre-operational"
    bench.node.receive(0, b"\x01\x00")  # all nodes
    assert bench.nmt_state() == "operational"


def test_a_stopped_node_ignores_sdos_and_pdos(bench):
    bench.configure()
    bench.nmt(2)
    bench.take()
    bench.node.receive(0x605, bytes.fromhex("40 00 10 00 00 00 00 00"))
    bench.rpdo(6, 0)
    bench.node.receive(0x80, b"")
    bench.wait(5)
    assert bench.take() == []


def test_reset_communication_restores_communication_only(bench):
    bench.configure()
    bench.write(0x1017, 0, 20, 2)
    bench.take()
    bench.nmt(130)
    assert frames(bench) == ["705 00"]
    assert bench.nmt_state() == "pre-operational"
    assert bench.read(0x1017) == 0
    assert bench.read(0x1400, 2) == 255
    assert bench.read(0x6060) == 10


def test_reset_node_restores_everything(bench):
    bench.configure()
    bench.nmt(129)
    assert bench.read(0x6060) == 0
    assert bench.read(0x1A00) == 1


def test_a_configured_sync_counter_is_required(bench):
    bench.write(0x1019, 0, 10, 1)
    bench.configure()
    bench.take()
    bench.node.receive(0x80, b"")
    assert frames(bench) == ["085 40 82 11 00 00 00 00 00"]
    bench.node.receive(0x80, b"\x01")
    assert frames(bench)[0] == "085 00 00 00 00 00 00 00 00"
    assert bench.write(0x1019, 0, 1, 1) == 0x06090030
    bench.write(0x1006, 0, 1000, 4)
    assert bench.write(0x1019, 0, 0, 1) == 0x08000022


def test_the_moved_identifiers_of_sync_and_emcy_are_used(bench):
    assert bench.write(0x1005, 0, 0x90, 4) == 0
    assert bench.write(0x1014, 0, 0x8000_0000 | 0x85, 4) == 0
    assert bench.write(0x1014, 0, 0xA5, 4) == 0
    bench.configure()
    assert bench.sync() is None
    bench.node.receive(0x90, b"")
    assert [can_id for can_id, _ in bench.take()] == [0x185]
    bench.node.emergency(0x2310, 0x02, b"")
    assert frames(bench)[0].startswith("0A5 10 23 03")
    assert bench.read(0x1014) == 0xA5
