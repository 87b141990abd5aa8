"""The world between its lines: periods, routing and faults, frame by frame."""

import random
import struct
import time

import numpy as np
import pytest

from rigd.devices.obstacles import ImpactSpecification, Obstacle
from rigd.sim.wire import WrongUseError, parse_fault

PERIOD_NS = 1_000_000
RPDO, POLL = 0x201, 0x680


def frame(can_id, data=b""):
    return struct.pack("=IB3x8s", can_id, len(data), data)


SYNC = frame(0x80)


def numbered(n):
    return frame(RPDO, struct.pack("<I", n))


def numbers(frames, can_id=RPDO):
    return [struct.unpack("<I", data)[0] for got, data in frames if got == can_id]


# Periods


def test_each_sync_moves_the_rig_before_the_drive_answers(make_world):
    rig = make_world()
    rig.sync(1, 2, 3)
    assert rig.answers() == [1, 2, 3]
    assert rig.drive.ticks_s == pytest.approx([0.001, 0.002, 0.003])


def test_missed_syncs_pass_as_periods_before_the_next_one(make_world):
    rig = make_world()
    rig.sync(1, 2, 5)
    assert rig.answers() == [1, 2, 5]
    assert len(rig.drive.ticks_s) == 5


def test_the_world_moves_by_the_clock_without_sync(make_world):
    rig = make_world()
    rig.world.elapse(round(20.6 * PERIOD_NS))
    assert rig.world.rig_periods == 20
    rig.sync(21)
    assert rig.answers() == [21]


def test_each_sync_after_a_pause_is_a_period(make_world):
    rig = make_world()
    rig.sync(*range(1, 11))
    rig.world.receive_frames([SYNC, numbered(1), SYNC, numbered(2), SYNC], "host", 13 * PERIOD_NS)
    rig.world.elapse(round(13.2 * PERIOD_NS))
    rig.sync(14)
    assert rig.answers() == [*range(1, 15)]


def test_waiting_time_of_the_loop(make_world):
    rig = make_world()
    assert rig.world.wait_s(0, 0.01) == 0.01
    rig.sync(*range(1, 20))
    assert rig.world.wait_s(19 * PERIOD_NS, 0.01) == pytest.approx(0.0015)
    assert rig.world.wait_s(21 * PERIOD_NS, 0.01) == 0.0
    rig.world.elapse(200 * PERIOD_NS)
    assert rig.world.wait_s(200 * PERIOD_NS, 0.01) == 0.01


def test_a_frozen_drive_does_not_stop_the_world(make_world):
    rig = make_world()
    rig.drive.frozen = True
    rig.sync(1, 2)
    rig.drive.frozen = False
    rig.sync(3)
    assert rig.answers() == [3]


def test_only_syncs_move_the_rig_in_lock_step(make_world):
    rig = make_world(lock_step=True)
    rig.simulated.plant.enable()
    rig.sync(0.1, 0.2, 700, 701)
    rig.world.elapse(round(900 * PERIOD_NS))
    assert rig.answers() == [1, 2, 3, 4]
    assert rig.world.rig_periods == 4


def test_a_dead_host_is_detected_in_lock_step(make_world):
    rig = make_world(lock_step=True)
    rig.simulated.plant.enable()
    rig.sync(1)
    rig.world.stop_waiting(2 * PERIOD_NS)
    rig.world.elapse(52 * PERIOD_NS)
    assert rig.drive.ticks_s[-1] == pytest.approx(0.051)
    assert rig.world.rig_periods == 51


def test_a_resting_rig_waits_for_set_up_in_lock_step(make_world):
    rig = make_world(lock_step=True)
    rig.world.elapse(500 * PERIOD_NS)
    assert rig.drive.ticks_s[-1] == pytest.approx(0.5)
    assert rig.world.rig_periods == 0


@pytest.mark.parametrize("seed", [1, 2])
def test_lock_step_is_independent_of_arrival_times(make_world, seed):
    chance = random.Random(seed)
    rig = make_world(lock_step=True)
    rig.simulated.plant.enable()
    now = 0
    angles = []
    for tick in range(300):
        now += chance.randrange(1, 5_000_000)
        rig.simulated.plant.command(0.2 if tick < 100 else -0.1)
        rig.world.receive_frames([SYNC], "host", now)
        rig.world.elapse(now + 1000)
        angles.append((rig.simulated.plant.angle_rad, rig.simulated.sensor.measure()))
    direct = make_world().simulated
    direct.plant.enable()
    for tick in range(300):
        direct.plant.command(0.2 if tick < 100 else -0.1)
        direct.advance(1)
        assert angles[tick] == (direct.plant.angle_rad, direct.sensor.measure())


# Routing


def test_nodes_and_other_hosts_receive_frames_of_a_host(make_world):
    rig = make_world()
    rig.world.receive_frames([numbered(7)], "host", 0)
    assert rig.drive.received == rig.sensor.received == [(RPDO, struct.pack("<I", 7))]
    assert rig.sent == [(numbered(7), "host")]


def test_nodes_receive_frames_of_others_only(make_world):
    rig = make_world()
    rig.sync(1)
    rig.world.receive_frames([frame(POLL)], "host", PERIOD_NS)
    assert [can_id for can_id, _ in rig.sensor.received] == [0x80, 0x181, POLL]
    assert [can_id for can_id, _ in rig.drive.received] == [0x80, POLL, 0x680, 0x681]
    assert [origin for _, origin in rig.sent] == ["host", None, "host", None, None]


def test_other_kinds_of_frames_are_dropped(make_world):
    rig = make_world()
    remote, long_id, error = 0x4000_0181, 0x8000_0080, 0x2000_0004
    flagged = [struct.pack("=IB3x8s", can_id, 0, b"") for can_id in (remote, long_id, error)]
    rig.world.receive_frames(flagged, "host", PERIOD_NS)
    assert rig.drive.received == []


# Faults of a line


def received_frames(rig, first, last):
    for n in range(first, last):
        rig.world.receive_frames([numbered(n)], "host", n * 1000)
    return numbers(rig.drive.received)


@pytest.mark.parametrize(
    ("spec", "expected"),
    [
        ("drop,from=host,frames=3", [3, 4, 5, 6, 7]),
        ("drop,from=host,id=0x201,frames=2", [2, 3, 4, 5, 6, 7]),
        ("drop,from=host,id=0x202,frames=2", [0, 1, 2, 3, 4, 5, 6, 7]),
        ("drop,from=drive,frames=2", [0, 1, 2, 3, 4, 5, 6, 7]),
        ("reorder,from=host", [1, 0, 2, 3, 4, 5, 6, 7]),
        ("reorder,from=host,frames=3", [1, 0, 3, 2, 5, 4, 6, 7]),
        ("corrupt,from=host,frames=2", [0xFF, 0xFE, 2, 3, 4, 5, 6, 7]),
        ("corrupt,from=host,byte=3", [0xFF000000, 1, 2, 3, 4, 5, 6, 7]),
        ("corrupt,from=host,byte=4", [0, 1, 2, 3, 4, 5, 6, 7]),
    ],
)
def test_line_faults_hit_exactly_the_requested_frames(make_world, spec, expected):
    rig = make_world()
    rig.world.inject(parse_fault(spec))
    assert received_frames(rig, 0, 8) == expected


def test_two_faults_hit_one_frame_after_the_other(make_world):
    rig = make_world()
    rig.world.inject(parse_fault("drop,from=host,frames=2"))
    rig.world.inject(parse_fault("corrupt,from=host,frames=2"))
    assert received_frames(rig, 0, 6) == [2 ^ 0xFF, 3 ^ 0xFF, 4, 5]
    assert rig.world.disturbed_senders == []
    hits = [what for _, device, what, _ in rig.log.entries if what in ("drop", "corrupt")]
    assert hits == ["drop", "drop", "corrupt", "corrupt"]


def test_other_hosts_receive_what_the_nodes_receive(make_world):
    rig = make_world()
    rig.world.inject(parse_fault("drop,from=host"))
    rig.world.inject(parse_fault("corrupt,from=host"))
    received_frames(rig, 0, 3)
    assert [raw for raw, _ in rig.sent] == [numbered(0xFE), numbered(2)]


def test_a_delayed_reply_comes_on_time(make_world):
    rig = make_world()
    rig.sync(1)
    rig.world.inject(parse_fault("delay,from=drive,ms=0.3,frames=2"))
    rig.sync(2)
    assert rig.answers() == [1]
    assert rig.world.wait_s(2 * PERIOD_NS, 0.01) == pytest.approx(0.0003)
    rig.world.elapse(round(2.29 * PERIOD_NS))
    assert rig.answers() == [1]
    rig.world.elapse(round(2.31 * PERIOD_NS))
    assert rig.answers() == [1, 2]
    rig.sync(3)
    rig.sync(4)
    assert rig.answers() == [1, 2, 4]
    rig.world.elapse(round(4.1 * PERIOD_NS))
    assert rig.answers() == [1, 2, 4, 3]


def test_a_delay_is_simulated_time_in_lock_step(make_world):
    rig = make_world(lock_step=True)
    rig.world.inject(parse_fault("delay,from=drive,ms=2"))
    rig.sync(1)
    rig.world.elapse(round(4.9e9))
    rig.sync(4901)
    assert rig.answers() == [2]
    rig.sync(4902)
    assert rig.answers() == [2, 3, 1]


def test_a_lost_sync_is_a_period_without_reception(make_world):
    rig = make_world(lock_step=True)
    rig.sync(1)
    rig.world.inject(parse_fault("drop,from=host,id=0x80,frames=2"))
    rig.sync(2, 3, 4)
    assert rig.answers() == [1, 4]


# Faults of devices


def test_a_fault_waits_until_the_drive_is_enabled(make_world):
    rig = make_world()
    rig.world.inject(parse_fault("jump,counts=-500@0.02"))
    rig.sync(*range(1, 11))
    rig.simulated.plant.enable()
    rig.sync(*range(11, 31))
    assert rig.drive.angle_offset_counts == 0
    rig.sync(31)
    assert rig.drive.angle_offset_counts == -500
    assert rig.log.of("fault") == [
        (0.031, "simulator", "fault", {"fault": "jump,counts=-500@0.02"})
    ]


def test_a_later_fault_counts_from_the_enabling(make_world):
    rig = make_world()
    rig.simulated.plant.enable()
    rig.sync(*range(1, 11))
    rig.world.inject(parse_fault("jump,counts=1@0.015"))
    rig.world.inject(parse_fault("jump,counts=10@0.001"))
    rig.sync(11)
    assert rig.drive.angle_offset_counts == 10
    rig.sync(12, 13, 14, 15, 16)
    assert rig.drive.angle_offset_counts == 11


@pytest.mark.parametrize(
    ("spec", "device", "attribute", "normal", "value"),
    [
        ("freeze,device=drive,for=0.003", "drive", "frozen", False, True),
        ("freeze,device=sensor,for=0.003", "sensor", "frozen", False, True),
        ("saturate,gauge=4,for=0.003", "sensor", "saturate", None, 4),
        ("status,bits=0x0080,for=0.003", "sensor", "status_bits", 0, 0x80),
    ],
)
def test_a_fault_with_an_end_ends(make_world, spec, device, attribute, normal, value):
    rig = make_world()
    rig.sync(1)
    rig.world.inject(parse_fault(spec))
    seen = []
    for tick in range(2, 7):
        seen.append(getattr(getattr(rig, device), attribute))
        rig.sync(tick)
    assert seen == [value, value, value, normal, normal]
    assert [time_s for time_s, *_ in rig.log.of("fault over")] == [0.004]


LINE_KINDS = ("drop", "delay", "corrupt", "reorder")
ENDLESS = [
    ("freeze,device=drive", "drive", "frozen", False),
    ("freeze,device=sensor", "sensor", "frozen", False),
    ("sto", "drive", "sto_dropped", False),
    ("busoff", "world", "bus_off", False),
    ("saturate,gauge=4", "sensor", "saturate", None),
    ("status,bits=0x0080", "sensor", "status_bits", 0),
    ("stuck,what=encoder", "simulated", "stuck_encoder", None),
    ("lag,ms=3", "drive", "torque_lag_s", 0.0),
    ("no_bit_12", "drive", "never_sets_bit_12", False),
    ("no_pre_operational", "drive", "stays_operational", False),
    ("no_watch", "drive", "ignores_silent_host", False),
]


@pytest.mark.parametrize("kind", [True, False], ids=["by kind", "all"])
@pytest.mark.parametrize(("spec", "device", "attribute", "normal"), ENDLESS)
def test_a_fault_without_an_end_is_ended(make_world, spec, device, attribute, normal, kind):
    rig = make_world()
    fault = parse_fault(spec)
    rig.world.inject(fault)
    assert getattr(getattr(rig, device), attribute) != normal
    other = "sto" if fault.kind != "sto" else "freeze"
    rig.world.inject(parse_fault(f"end,fault={other}"))
    assert getattr(getattr(rig, device), attribute) != normal
    rig.world.inject(parse_fault(f"end,fault={fault.kind}" if kind else "end"))
    assert getattr(getattr(rig, device), attribute) == normal
    assert [values["fault"] for *_, values in rig.log.of("fault over")] == [str(fault)]
    rig.world.inject(parse_fault("end"))
    assert len(rig.log.of("fault over")) == 1


def test_every_lasting_fault_is_tested():
    with pytest.raises(WrongUseError) as refused:
        parse_fault("end,fault=none")
    lasting = str(refused.value).partition("give ")[2].rstrip(".")
    held = {spec.partition(",")[0] for spec, *_ in ENDLESS}
    assert {*held, *LINE_KINDS, "cut", "obstacle"} == set(lasting.split(" or "))


def torques_against_obstacle(rig, ticks):
    """Torque of the sensor tick by tick, the motor under a constant torque."""
    plant = rig.simulated.plant
    torques = []
    for tick in ticks:
        plant.command(0.1)
        rig.sync(tick)
        torques.append(plant.coupling_torque_nm)
    return np.array(torques)


def test_an_injected_obstacle_is_hit_and_ended(make_world):
    free, rig, ended = (
        make_world(lock_step=True),
        make_world(lock_step=True),
        make_world(lock_step=True),
    )
    for world in (free, rig, ended):
        world.simulated.plant.enable()
    before = [torques_against_obstacle(world, range(1, 60)) for world in (free, rig, ended)]
    assert (before[0] == before[1]).all()
    fault = parse_fault("obstacle,x=0.6,angle=0.15,stiffness=3000")
    for world in (rig, ended):
        world.world.inject(fault)
    later = [torques_against_obstacle(world, range(60, 200)) for world in (free, rig, ended)]
    assert np.abs(later[1] - later[0]).max() > 0.01
    assert np.array_equal(later[1], later[2])
    ended.world.inject(parse_fault("end,fault=obstacle"))
    assert [values["fault"] for *_, values in ended.log.of("fault over")] == [str(fault)]
    last = [torques_against_obstacle(world, range(200, 400)) for world in (free, rig, ended)]
    assert last[1].mean() > last[2].mean() + 0.01


def test_an_injected_impact_comes_once(make_world):
    rig = make_world(lock_step=True)
    rig.simulated.plant.enable()
    rig.sync(*range(1, 20))
    rig.world.inject(parse_fault("knock,x=0.5,force=1,duration=0.01"))
    seen = []
    for tick in range(20, 60):
        rig.sync(tick)
        seen.append(rig.simulated.plant.contact_forces_n.max())
    assert max(seen) == pytest.approx(1.0, abs=0.01)
    assert seen[12:] == [0.0] * len(seen[12:])


def test_the_rig_continues_while_an_obstacle_is_made(make_world):
    rig = make_world()
    rig.simulated.plant.enable()
    rig.world.inject(parse_fault("knock,x=0.5,force=1,duration=0.01"))
    rig.world.inject(parse_fault("obstacle,x=0.6,angle=0.1"))
    deadline_s = time.monotonic() + 30
    for tick in range(1, 100_000):
        rig.sync(tick)
        assert rig.simulated.plant.elapsed_s == pytest.approx(tick * 1e-3)
        contact = rig.simulated.plant._contact
        if contact is not None and len(contact.bodies) == 2:
            break
        time.sleep(0.001)
        assert time.monotonic() < deadline_s
    assert [type(body) for body in contact.bodies] == [ImpactSpecification, Obstacle]


def test_impossible_obstacles_are_refused(make_world, monkeypatch):
    monkeypatch.setattr("rigd.sim._devices._MAX_ADDED_DISTURBANCES", 1)
    rig = make_world(lock_step=True)
    with pytest.raises(WrongUseError, match="beyond the tip"):
        rig.world.inject(parse_fault("obstacle,x=1.5,angle=0.1"))
    rig.world.inject(parse_fault("knock,x=0.5,force=1,duration=0.01"))
    with pytest.raises(WrongUseError, match="1 obstacles and knocks were added"):
        rig.world.inject(parse_fault("knock,x=0.5,force=1,duration=0.01"))


def test_the_effect_of_two_faults_lasts_until_both_end(make_world):
    rig = make_world()
    rig.sync(1)
    rig.world.inject(parse_fault("freeze,device=drive,for=0.002"))
    rig.world.inject(parse_fault("freeze,device=drive,for=0.004"))
    seen = []
    for tick in range(2, 8):
        seen.append(rig.drive.frozen)
        rig.sync(tick)
    assert seen == [True, True, True, True, False, False]


@pytest.mark.parametrize("kind", LINE_KINDS)
def test_faults_of_a_line_are_ended(make_world, kind):
    rig = make_world()
    more = ",ms=1" if kind == "delay" else ""
    rig.world.inject(parse_fault(f"{kind},from=host,frames=1000{more}"))
    assert rig.world.disturbed_senders == ["host"]
    rig.world.inject(parse_fault("end"))
    assert rig.world.disturbed_senders == []
    assert received_frames(rig, 0, 3) == [0, 1, 2]


def test_a_cut_line_is_mended_once(make_world):
    rig = make_world(serial=True)
    for spec in ("cut", "cut", "cut,device=sensor", "end,fault=cut", "end"):
        rig.world.inject(parse_fault(spec))
    assert rig.mended == ["bus", "sensor"]


@pytest.mark.parametrize("kind", ["restart", "power_cycle"])
@pytest.mark.parametrize("device", ["drive", "sensor"])
def test_a_device_restarts(make_world, kind, device):
    rig = make_world()
    rig.world.inject(parse_fault(f"{kind},device={device}"))
    assert (rig.drive.restarts, rig.sensor.restarts) == (
        ([kind], []) if device == "drive" else ([], [kind])
    )


def test_an_emergency_comes_from_the_drive(make_world):
    rig = make_world()
    rig.world.inject(parse_fault("emcy,code=0x8130,register=0x11"))
    assert rig.drive.emergencies == [(0x8130, 0x11, bytes(5))]


def test_a_host_off_the_bus_neither_sends_nor_receives(make_world):
    rig = make_world()
    rig.sync(1)
    rig.sent.clear()
    rig.world.inject(parse_fault("busoff,for=0.003"))
    received = len(rig.drive.received)
    rig.sync(2, 3)
    assert [can_id for can_id, _ in rig.from_nodes()] == [0x2000_0040]
    assert len(rig.drive.received) == received
    assert rig.world.rig_periods == 3  # the world goes on
    rig.sync(4, 5)
    assert len(rig.drive.received) > received


def test_the_wired_stop_acts_on_the_drive(make_world):
    rig = make_world()
    rig.drive.sto_dropped = False
    rig.world.inject(parse_fault("sto"))
    assert rig.drive.sto_dropped


def test_the_owner_of_the_bus_cuts_it(make_world):
    rig = make_world()
    rig.world.inject(parse_fault("cut"))
    assert rig.cuts == ["bus"]


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("cut,device=sensor", "no serial line"),
        ("drop,from=sensor,bytes=3", "bytes is for a sensor on a serial line"),
        (
            "corrupt,from=drive,byte=8",
            "byte=8 has no effect; a CAN frame has at most the bytes 0 to 7",
        ),
    ],
)
def test_an_impossible_fault_is_refused(make_world, spec, message):
    rig = make_world()
    with pytest.raises(WrongUseError, match=message):
        rig.world.inject(parse_fault(spec + "@5"))


# The serial line


def records(rig):
    assert len(rig.written) % 13 == 0
    split = [rig.written[at : at + 13] for at in range(0, len(rig.written), 13)]
    assert all(record == record[:1] * 13 for record in split)
    return [record[0] for record in split]


def test_each_period_brings_its_records(make_world):
    rig = make_world(serial=True)
    rig.sync(1, 2)
    rig.world.elapse(round(4.6 * PERIOD_NS))
    assert records(rig) == [*range(28)]


def test_a_waiting_rig_in_lock_step_streams_nothing(make_world):
    rig = make_world(serial=True, lock_step=True)
    rig.world.elapse(500 * PERIOD_NS)
    rig.sync(501)
    assert records(rig) == [*range(7)]


def test_records_are_lost_and_swapped_one_by_one(make_world):
    rig = make_world(serial=True)
    rig.sync(1)
    rig.world.inject(parse_fault("drop,from=sensor,frames=8"))
    rig.world.inject(parse_fault("reorder,from=sensor,frames=2"))
    rig.sync(2, 3)
    assert records(rig) == [*range(7), 16, 15, 18, 17, 19, 20]


def test_a_record_comes_late_or_with_a_wrong_byte(make_world):
    rig = make_world(serial=True)
    rig.world.inject(parse_fault("corrupt,from=sensor,byte=12"))
    rig.sync(1)
    assert rig.written[:13] == bytes([0] * 12 + [0xFF])
    rig.written = b""
    rig.world.inject(parse_fault("delay,from=sensor,ms=0.5"))
    rig.sync(2)
    rig.world.elapse(round(2.6 * PERIOD_NS))
    assert records(rig) == [8, 9, 10, 11, 12, 13, 7]


def test_bytes_are_lost_across_records(make_world):
    rig = make_world(serial=True)
    rig.world.inject(parse_fault("drop,from=sensor,bytes=16"))
    rig.sync(1)
    assert rig.written[:10] == bytes([1] * 10)
    assert len(rig.written) == 7 * 13 - 16


def test_no_identifiers_on_a_serial_line(make_world):
    rig = make_world(serial=True)
    with pytest.raises(WrongUseError, match="id is for a sensor on CAN"):
        rig.world.inject(parse_fault("drop,from=sensor,id=1"))
    rig.world.inject(parse_fault("cut,device=sensor"))
    assert rig.cuts == ["sensor"]
