"""Drives that lack objects, or have them read-only: substitutes, and refusals by name."""

from dataclasses import replace

import pytest

from rigd.devices.cia402.requirements import Watchdog
from rigd.devices.contracts import DeviceError

READ_ONLY, ABSENT, GENERAL = 0x06010002, 0x06020000, 0x08000000


def without(scripted, *addresses):
    for address in addresses:
        scripted.objects.pop(address, None)


@pytest.fixture
def make(make_drive, rig, settings):
    def make(**changes):
        return make_drive(replace(rig, cia402=replace(settings, **changes)))

    return make


def written(scripted):
    return {(index, sub): value for index, sub, value in scripted.writes}


class TestRealDrives:
    """Limits and objects of their public EDS files."""

    def test_elmo_gold_has_far_read_only_torque_limits(self, make, scripted):
        scripted.objects |= {(0x60E0, 0): 50_000, (0x60E1, 0): 50_000}
        scripted.read_only |= {(0x60E0, 0), (0x60E1, 0)}
        drive = make()
        drive.connect()
        assert drive.capabilities().accepted_missing_functions == ()
        drive.enable()
        assert scripted.state == "enabled"

    def test_epos4_has_no_6072_and_no_1006(self, make, scripted):
        without(scripted, (0x6072, 0), (0x1006, 0))
        scripted.objects[0x3001, 2] = 1000
        drive = make(accept_without=("torque_limit",), set_objects=("3001:2 u32 2500",))
        drive.connect()
        assert scripted.objects[0x3001, 2] == 2500
        assert [row.address for row in drive.capabilities().missing_objects] == ["6072", "1006"]
        statement = drive.statement()
        assert statement["drive_without"] == "torque_limit"
        assert statement["drive_objects_set"] == "3001:2 u32 2500"
        assert "1006: transmission type 1" in statement["drive_stand_ins"]
        drive.enable()
        assert scripted.state == "enabled"

    def test_a_missing_torque_limit_has_to_be_accepted_by_name(self, make, scripted):
        without(scripted, (0x6072, 0))
        with pytest.raises(
            DeviceError, match=r'no object 6072.*accept_without = \["torque_limit"\]'
        ):
            make().connect()


@pytest.mark.parametrize("index", [0x60E0, 0x60E1])
def test_a_low_read_only_limit_is_refused_by_name(make, scripted, index):
    scripted.objects[index, 0] = 1799
    scripted.read_only.add((index, 0))
    words = rf"{index:04X} .*is 1799 but must be 1800.*read-only.*motor\.peak_torque_nm"
    with pytest.raises(DeviceError, match=words):
        make().connect()


def test_a_read_only_object_with_the_needed_value_is_accepted(make, scripted):
    scripted.objects |= {(0x6072, 0): 1800, (0x60C2, 1): 1, (0x6007, 0): 2, (0x1017, 0): 20}
    scripted.read_only |= {(0x6072, 0), (0x60C2, 1), (0x60C2, 2), (0x6007, 0), (0x1017, 0)}
    make().connect()


def test_a_high_read_only_limit_does_not_count(make, scripted):
    scripted.objects[0x6072, 0] = 5000
    scripted.read_only.add((0x6072, 0))
    with pytest.raises(DeviceError, match=r"6072 .*is 5000 but must be 1800"):
        make().connect()


def test_a_high_limit_may_be_accepted_by_name(make, scripted):
    scripted.objects[0x6072, 0] = 5000
    scripted.read_only.add((0x6072, 0))
    drive = make(accept_without=("torque_limit",))
    drive.connect()
    assert drive.capabilities().accepted_missing_functions == ("torque_limit",)


def test_a_write_only_mode_is_written_and_read_from_6061(make, scripted):
    scripted.write_only |= {(0x6060, 0)}
    drive = make()
    drive.connect()
    assert written(scripted)[0x6060, 0] == 10
    drive.enable()
    assert scripted.state == "enabled"


def test_an_ignored_write_only_mode_is_named(make, scripted):
    scripted.write_only |= {(0x6060, 0)}
    scripted.refuse_value[0x6060, 0] = 0x06090030
    with pytest.raises(DeviceError, match=r"object 6060.*0x06090030"):
        make().connect()


def test_a_write_only_object_with_an_unknown_value_is_refused(make, scripted):
    scripted.objects[0x60B2, 0] = 5
    scripted.write_only |= {(0x60B2, 0)}
    with pytest.raises(DeviceError, match="reading object 60B2"):
        make().connect()


@pytest.mark.parametrize("code", [ABSENT, GENERAL, 0x06090011, 0x060A0023, 0x05040001])
def test_abort_codes_of_absent_objects(make, scripted, code):
    scripted.refuse |= dict.fromkeys([(0x1006, 0), (0x60C2, 1), (0x60C2, 2)], code)
    drive = make()
    drive.connect()
    assert {row.address for row in drive.capabilities().missing_objects} == {
        "1006",
        "60C2:1",
        "60C2:2",
    }


class TestWatchdog:
    """A missing watchdog is always reported."""

    def test_the_heartbeat_consumer(self, make):
        drive = make()
        drive.connect()
        assert drive.statement() == {
            "drive_identity": "0x1234 0xABCD 0x10002 0x4D",
            "drive_watchdog": "heartbeat consumer (1016:1)",
            "drive_watchdog_s": "0.05",
        }

    def test_no_watchdog_is_refused(self, make, scripted):
        without(scripted, (0x1016, 1))
        with pytest.raises(DeviceError) as caught:
            make().connect()
        message = str(caught.value)
        for words in ("1016:1", "cia402.own_watchdog_s", 'accept_without = ["watchdog"]'):
            assert words in message

    def test_the_deadline_of_the_rpdo_is_a_substitute(self, make, scripted):
        without(scripted, (0x1016, 1))
        scripted.objects[0x1400, 5] = 0
        drive = make()
        drive.connect()
        assert scripted.objects[0x1400, 5] == 50
        assert drive.capabilities().watchdog is Watchdog.RPDO_DEADLINE
        # The drive times them from the first on, so they continue without a commanded torque.
        scripted.seen.clear()
        for k in range(5):
            drive.latch(k * 1_000_000)
            drive.read_angle()
        assert len(scripted.frames(0x205)) == 5

    def test_own_watchdog_of_the_profile_is_a_substitute(self, make, scripted):
        without(scripted, (0x1016, 1), (0x6007, 0))
        drive = make(own_watchdog_s=0.03)
        drive.connect()
        assert drive.statement()["drive_watchdog_s"] == "0.03"
        assert "manufacturer's own" in drive.statement()["drive_watchdog"]

    def test_no_watchdog_is_accepted_by_name_and_reported(self, make, scripted, rig):
        without(scripted, (0x1016, 1))
        drive = make(accept_without=("watchdog",))
        drive.connect()
        assert drive.statement()["drive_watchdog_s"] == "inf"
        assert drive.statement()["drive_without"] == "watchdog"
        assert drive.capabilities().watchdog is Watchdog.NONE

    def test_a_watchdog_with_unknown_reaction(self, make, scripted):
        without(scripted, (0x6007, 0))
        with pytest.raises(DeviceError, match=r'no object 6007.*\["abort_option"\]'):
            make().connect()

    def test_an_unknown_reaction_may_be_accepted_by_name(self, make, scripted):
        without(scripted, (0x6007, 0))
        drive = make(accept_without=("abort_option",))
        drive.connect()
        assert drive.capabilities().accepted_missing_functions == ("abort_option",)

    def test_the_old_entry_of_a_node_is_cleared_first(self, make, scripted):
        scripted.objects |= {(0x1016, 0): 3, (0x1016, 2): 100 << 16 | 70, (0x1016, 3): 9 << 16 | 5}
        make().connect()
        writes = [(index, sub, value) for index, sub, value in scripted.writes if index == 0x1016]
        assert writes == [(0x1016, 2, 0), (0x1016, 1, 100 << 16 | 50)]

    @pytest.mark.parametrize(
        ("changes", "time_s"),
        [
            ({}, 0.05),
            ({"own_watchdog_s": 0.03}, 0.05),
            ({"own_watchdog_s": 0.3}, 0.3),
            ({"accept_without": ("watchdog",)}, float("inf")),
            ({"accept_without": ("torque_limit",)}, 0.05),
        ],
    )
    def test_watchdog_time_of_a_profile(self, settings, changes, time_s):
        assert replace(settings, **changes).watchdog_s == time_s


class TestValuesFromBefore:
    @pytest.mark.parametrize(
        ("address", "value"), [((0x1007, 0), 100), ((0x1019, 0), 10), ((0x1800, 3), 10)]
    )
    def test_values_from_before_are_cleared(self, make, scripted, address, value):
        scripted.objects[address] = value
        make().connect()
        assert scripted.objects[address] == 0

    @pytest.mark.parametrize("address", [(0x1007, 0), (0x1019, 0), (0x1800, 3), (0x60B2, 0)])
    def test_values_that_cannot_be_cleared_are_refused_by_name(self, make, scripted, address):
        scripted.objects[address] = 10
        scripted.read_only.add(address)
        index, sub = address
        with pytest.raises(DeviceError, match=f"{index:04X}{f':{sub}' if sub else ''} .*is 10"):
            make().connect()

    def test_the_sync_counter_is_changed_while_the_period_is_0(self, make, scripted):
        scripted.objects |= {(0x1019, 0): 10, (0x1006, 0): 2000}
        make().connect()
        order = [write[:1] + write[2:] for write in scripted.writes if write[0] in (0x1006, 0x1019)]
        assert order == [(0x1006, 0), (0x1019, 0), (0x1006, 1000)]

    def test_the_inhibit_time_is_changed_while_the_pdo_is_off(self, make, scripted):
        scripted.objects[0x1800, 3] = 10
        make().connect()
        order = [write for write in scripted.writes if write[0] == 0x1800]
        assert order.index((0x1800, 3, 0)) > order.index((0x1800, 1, 0xC0000185))
        assert order[-1] == (0x1800, 1, 0x40000185)

    def test_pdos_beyond_the_fourth_are_switched_off(self, make, scripted):
        for n in range(2, 7):
            scripted.objects[0x1400 + n, 1] = 0x300 + n
            scripted.objects[0x1800 + n, 1] = 0x40000280 + n
        make().connect()
        for n in range(1, 7):
            assert scripted.objects[0x1400 + n, 1] & 0x80000000
            assert scripted.objects[0x1800 + n, 1] & 0x80000000

    @pytest.mark.parametrize("polarity", [0x80, 0x40, 0xC0])
    def test_a_polarity_is_refused_by_name(self, make, scripted, polarity):
        scripted.objects[0x607E, 0] = polarity
        with pytest.raises(
            DeviceError, match=rf"607E \(Polarity\) is 0x{polarity:02X}.*is unstable"
        ):
            make().connect()
        assert (0x607E, 0) not in written(scripted)

    def test_a_polarity_set_to_0_by_the_profile_is_accepted(self, make, scripted):
        scripted.objects[0x607E, 0] = 0x80
        make(set_objects=("607E:0 u8 0",)).connect()

    def test_reactions_are_reported(self, make, scripted):
        scripted.objects |= {(0x605A, 0): 2, (0x605E, 0): 0}
        drive = make()
        drive.connect()
        assert drive.identity()["quick_stop_option"] == 2
        assert drive.identity()["fault_reaction_option"] == 0


def test_pdos_already_mapped_as_needed_may_be_read_only(make, scripted):
    scripted.objects |= {
        (0x1800, 1): 0x40000185, (0x1800, 2): 1, (0x1400, 1): 0x205, (0x1400, 2): 1,
        (0x1A00, 0): 3, (0x1A00, 1): 0x60410010, (0x1A00, 2): 0x60640020, (0x1A00, 3): 0x60770010,
        (0x1600, 0): 2, (0x1600, 1): 0x60400010, (0x1600, 2): 0x60710010,
    }  # fmt: skip
    mapping = {
        address for address in scripted.objects if address[0] in (0x1400, 0x1800, 0x1600, 0x1A00)
    }
    scripted.read_only |= mapping
    drive = make()
    drive.connect()
    drive.enable()
    assert scripted.state == "enabled"


def test_an_unmappable_target_torque_is_named(make, scripted):
    scripted.refuse_value[0x1600, 2] = 0x06040041
    with pytest.raises(DeviceError, match=r"6071 \(Target torque\) into RPDO1.*cannot be mapped"):
        make().connect()


class TestMissingActualTorque:
    def test_a_drive_without_torque_is_refused(self, make, scripted):
        scripted.refuse_value[0x1A00, 3] = ABSENT
        with pytest.raises(DeviceError, match=r'no object 6077.*\["torque_feedback"\]'):
            make().connect()

    def test_accepted_by_name(self, make, scripted):
        scripted.short_tpdo = True
        drive = make(accept_without=("torque_feedback",), torque_tolerance_percent=10.0)
        drive.connect()
        assert scripted.objects[0x1A00, 0] == 2
        drive.enable()
        for k in range(30):
            drive.latch(k * 1_000_000)
            drive.read_angle()
            assert not drive.angle_stale
            drive.command(0.4)


def test_tpdos_replace_a_missing_heartbeat(make, scripted):
    without(scripted, (0x1017, 0))
    scripted.heartbeat_every = 10**9
    scripted.nmt_heartbeats = False
    drive = make()
    drive.connect()
    drive.enable()
    for k in range(100):
        drive.latch(k * 1_000_000)
        drive.read_angle()
    assert drive.capabilities().watchdog is Watchdog.HEARTBEAT


def test_no_torque_mode_is_refused_within_a_second(make, scripted):
    import time

    scripted.objects[0x6502, 0] = 0x6D
    began = time.monotonic()
    with pytest.raises(DeviceError, match=r"no cyclic synchronous torque.*6502 = 109"):
        make().connect()
    assert time.monotonic() - began < 1


class TestEds:
    TEXT = """[DeviceInfo]
VendorName=any
VendorNumber={vendor}
ProductName=any
ProductNumber={product}

[OptionalObjects]
SupportedObjects=1
1=0x60E0

[60E0]
ParameterName=Positive torque limit
ObjectType=0x7
DataType=0x0007
AccessType=rw
PDOMapping=0
"""

    def eds(self, tmp_path, vendor="0x1234", product="0xABCD"):
        path = tmp_path / "drive.eds"
        path.write_text(self.TEXT.format(vendor=vendor, product=product))
        return str(path)

    def test_types_of_the_eds_are_used(self, make, scripted, tmp_path):
        scripted.objects[0x60E0, 0] = 70_000  # no u16 holds that
        scripted.formats[0x60E0] = "<I"
        make(eds=self.eds(tmp_path)).connect()
        assert scripted.objects[0x60E0, 0] == 1800

    def test_another_vendor_is_refused(self, make, scripted, tmp_path):
        with pytest.raises(DeviceError, match=r"VendorNumber in .*drive\.eds is 0x00000099"):
            make(eds=self.eds(tmp_path, vendor="0x99")).connect()

    def test_another_product_is_refused(self, make, scripted, tmp_path):
        with pytest.raises(DeviceError, match=r"ProductNumber in .*drive\.eds is 0x00000007"):
            make(eds=self.eds(tmp_path, product="7")).connect()

    def test_a_missing_type_is_that_of_the_standard(self, make, tmp_path):
        path = tmp_path / "drive.eds"
        path.write_text("[6040]\nDataType=x\n[6072]\nParameterName=Max torque\n")
        make(eds=str(path)).connect()

    @pytest.mark.parametrize("content", ["nonsense", "[60E0\n", "\0\0", "<xml/>"])
    def test_an_invalid_file(self, make, scripted, tmp_path, content):
        path = tmp_path / "broken.eds"
        path.write_text(content)
        scripted.state, scripted.torque = "enabled", 200
        with pytest.raises(DeviceError, match=r"broken\.eds: is .*Get it again"):
            make(eds=str(path)).connect()
        # Not even that leaves a drive turning.
        assert (scripted.state, scripted.torque) == ("switch-on disabled", 0)


def test_bit_12_is_demanded(make, scripted):
    scripted.follows = False
    drive = make()
    drive.connect()
    with pytest.raises(DeviceError, match=r"bit 12.*follows_target_bit = false"):
        drive.enable()


def test_a_drive_without_bit_12(make, scripted):
    scripted.follows = False
    drive = make(follows_target_bit=False)
    drive.connect()
    drive.enable()
    for k in range(20):
        drive.latch(k * 1_000_000)
        drive.read_angle()
