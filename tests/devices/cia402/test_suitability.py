"""Suitability of a drive by its EDS: findings, grades and refusals."""

from dataclasses import replace

import pytest
from eds_files import (
    COMPLETE,
    WITH_TORQUE,
    WITHOUT_TORQUE,
    changed,
    eds_path,
    eds_text,
    without,
)

from rigd.devices.cia402 import Grade, check_suitability
from rigd.devices.cia402.requirements import CORE_REQUIREMENTS, OPTIONAL_REQUIREMENTS, requirement
from rigd.devices.eds import read_eds
from rigd.profile import load_profile

pytestmark = pytest.mark.fit


@pytest.fixture(scope="module")
def shipped():
    return load_profile("antenna_can").rig


@pytest.fixture
def rig(shipped):
    """The shipped rig with other values of its drive."""

    def rig(**values):
        return replace(shipped, cia402=replace(shipped.cia402, **values))

    return rig


@pytest.fixture
def check(tmp_path):
    """Check a drive by the table of its objects, or by the text of its file."""

    def check(table, rig=None):
        path = tmp_path / "drive.eds"
        path.write_text(table if table.startswith("[") else eds_text(table))
        return check_suitability(read_eds(path), rig)

    return check


def by_address(suitability):
    return {finding.checked_item.split()[0]: finding for finding in suitability.findings}


def test_a_complete_drive_fits(check, rig):
    for suitability in (check(COMPLETE), check(COMPLETE, rig())):
        assert suitability.refusals == ()
        grades = {f.checked_item: f.grade for f in suitability.findings}
        assert set(grades.values()) == {Grade.FITS, Grade.SUBSTITUTED}
        # A finding for every object of the table, except the identity and those stated in words.
        assert len(grades) == len(CORE_REQUIREMENTS) + len(OPTIONAL_REQUIREMENTS) - 4 + 5


@pytest.mark.parametrize("name", WITH_TORQUE)
def test_drives_with_torque_mode_are_not_refused(name):
    suitability = check_suitability(read_eds(eds_path(name)))
    assert suitability.refusals == ()
    mode = by_address(suitability)["6502"]
    optional = name in ("e35", "epos4_0110")
    assert mode.grade is (Grade.FITS if optional else Grade.ASK)


@pytest.mark.parametrize(
    ("name", "modes"),
    list(zip(WITHOUT_TORQUE, ("0x6D", "0x43", "0x63", "0xA5", "0x1F0065"), strict=True)),
)
def test_drives_without_torque_mode_are_refused(name, modes):
    first = check_suitability(read_eds(eds_path(name))).refusals[0]
    assert first.startswith("No cyclic synchronous torque mode: object 6502 = ")
    assert f"{modes} lacks bit 9" in first


def test_deficiencies_of_the_two_real_drives(rig):
    elmo = by_address(check_suitability(read_eds(eds_path("elmo_gold")), rig()))
    for address in ("60E0", "60E1"):
        assert elmo[address].grade is Grade.FITS
        assert elmo[address].stated_text == "ro, 50000: it does"
        assert elmo[address].required_text == "at least 1800"
    assert not [f for f in elmo.values() if f.grade is Grade.REFUSED]

    epos = read_eds(eds_path("epos4_0170"))
    (refusal,) = check_suitability(epos, rig()).refusals
    assert "6072 (Max torque)" in refusal
    assert 'cia402.accept_without = ["torque_limit"]' in refusal
    accepted = by_address(check_suitability(epos, rig(accept_without=("torque_limit",))))
    assert accepted["6072"].grade is Grade.ACCEPTED
    assert accepted["1006"].grade is Grade.SUBSTITUTED
    assert not [f for f in accepted.values() if f.grade is Grade.REFUSED]


@pytest.mark.parametrize("needed", CORE_REQUIREMENTS, ids=lambda needed: needed.address)
def test_a_missing_core_object_is_refused_by_name(check, needed):
    address = f"{needed.index:04X}:{needed.subindex}"
    found = check(without(address if f"{address} " in COMPLETE else needed.address))
    (refusal,) = found.refusals
    assert needed.address in refusal
    if needed.index == 0x6502:
        assert refusal == "No cyclic synchronous torque mode: object 6502 is missing."
    else:
        assert f"({needed.name})" in refusal


@pytest.mark.parametrize("modes", ["-", "0"])
def test_a_file_without_modes_leaves_the_question_to_the_drive(check, modes):
    found = check(changed("6502", f"u32 ro {modes}"))
    assert found.refusals == ()
    assert by_address(found)["6502"].grade is Grade.ASK
    assert "rigd reads it from the drive" in by_address(found)["6502"].stated_text


def test_a_mode_that_cannot_be_set_does_not_count(check):
    table = eds_text(changed("6502", "u32 ro -")).replace(
        "[6060]", "[6060]\nLowLimit=-1\nHighLimit=9"
    )
    (refusal,) = check(table).refusals
    assert "6060 (Modes of operation) takes -1 to 9, not 10" in refusal
    # Limits that make no sense are none.
    table = table.replace("HighLimit=9", "HighLimit=-5")
    assert check(table).refusals == ()


@pytest.mark.parametrize(
    ("address", "line", "words"),
    [
        ("6071", "i16 rww 0", "cannot be mapped into a PDO"),
        ("6064", "i16 ro 0 *", "has 16 bits, not 32"),
        ("6040", "u16 ro 0 *", "is read-only and does not have the required value"),
        ("1600:0", "u8 ro 1", "is read-only and does not have"),
        ("1800:2", "u8 ro 255", "is read-only and does not have the required value (1)"),
        (
            "1400:1",
            "u32 ro 0x80000201",
            "is read-only and does not have the required value (0x201)",
        ),
        ("60B2", "i16 ro 5 *", "is read-only and does not have the required value (0)"),
        ("1800:3", "u16 ro 10", "is read-only and does not have the required value (0)"),
    ],
)
def test_unusable_objects_are_refused(check, address, line, words):
    (refusal,) = check(changed(address, line)).refusals
    assert address.removesuffix(":0") in refusal
    assert words in refusal


@pytest.mark.parametrize(
    ("address", "line", "found"),
    [
        ("1005", "u32 const 0x80", "const, 0x80: it does"),
        ("1014", "u32 const $NODEID+0x80", "const, 0x81: it does"),
        ("60B2", "i16 ro 0 *", "ro, 0: it does"),
        ("1400:2", "u8 ro -", "ro: rigd reads it from the drive"),
    ],
)
def test_read_only_objects_may_have_the_needed_value(check, address, line, found):
    suitability = check(changed(address, line))
    assert suitability.refusals == ()
    assert by_address(suitability)[address].stated_text == found


def test_fixed_pdos_mapped_as_needed(check):
    fixed = (
        COMPLETE.replace("1600:0 u8 rw 1", "1600:0 u8 const 2")
        .replace("1600:1 u32 rw", "1600:1 u32 const")
        .replace("1600:2 u32 rw 0", "1600:2 u32 const 0x60710010")
    )
    suitability = check(fixed)
    assert suitability.refusals == ()
    assert by_address(suitability)["1600"].stated_text == "const, 2: it does"
    always_on = fixed.replace("1400:1 u32 rw", "1400:1 u32 const")
    assert by_address(check(always_on))["1400:1"].stated_text == "const, 0x201: it does"
    (refusal,) = check(changed("1400:1", "u32 const 0x201")).refusals
    assert "1400:1 (COB-ID of RPDO1) is read-only" in refusal
    (refusal,) = check(fixed.replace("0x60710010", "0x60FF0020")).refusals
    assert "1600 (Mapping of RPDO1) is read-only" in refusal


def test_objects_of_an_existing_mapping_can_be_mapped(check):
    table = changed("6040", "u16 rww 0")
    assert check(table).refusals == ()


def test_write_only_objects_are_doubtful_or_refused(check, rig):
    mode = by_address(check(changed("6060", "i8 wo -"), rig()))["6060"]
    assert mode.grade is Grade.DOUBT
    assert "write-only" in mode.consequence
    (refusal,) = check(changed("60B2", "i16 wo -"), rig()).refusals
    assert "60B2" in refusal
    assert "write-only" in refusal


def test_a_missing_watchdog_is_reported(check, rig):
    unwatched = without("1016:1")
    warned = by_address(check(unwatched))["watchdog"]
    assert warned.grade is Grade.DOUBT
    assert warned.acceptance_name == "watchdog"
    (refusal,) = check(unwatched, rig()).refusals
    assert "1016:1" in refusal
    assert 'cia402.accept_without = ["watchdog"]' in refusal
    assert len(check(unwatched, rig(accept_without=("torque_limit",))).refusals) == 1
    accepted = by_address(check(unwatched, rig(accept_without=("watchdog",))))["watchdog"]
    assert accepted.grade is Grade.ACCEPTED
    for table, values, words in (
        (unwatched + "\n1400:5 u16 rw 0", {}, "deadline of the RPDO"),
        (unwatched, {"own_watchdog_s": 0.1}, "own watchdog"),
    ):
        watchdog = by_address(check(table, rig(**values)))["watchdog"]
        assert watchdog.grade is Grade.SUBSTITUTED
        assert words in watchdog.stated_text
    # What the drive does on a lost connection is then its maker's choice anyway.
    for values in ({"own_watchdog_s": 0.1}, {"accept_without": ("watchdog",)}):
        assert check(without("1016:1", "6007"), rig(**values)).refusals == ()
    assert len(check(without("6007"), rig()).refusals) == 1
    read_only = check(changed("1016:1", "u32 ro 0"), rig())
    assert len(read_only.refusals) == 1


@pytest.mark.parametrize(
    ("address", "key"), [("6080", "max_speed_rad_s"), ("6076", "rated_torque_unit_nm")]
)
def test_objects_needed_by_the_profile_must_exist(check, rig, address, key):
    assert check(without(address)).refusals == ()
    (refusal,) = check(without(address), rig()).refusals
    assert f"cia402.{key} = 0" in refusal
    assert check(without(address), rig(**{key: 0.0})).refusals == ()


def test_an_unmappable_actual_torque_may_be_accepted(check, rig):
    table = changed("6077", "i16 ro 0")
    (refusal,) = check(table, rig()).refusals
    assert 'cia402.accept_without = ["torque_feedback"]' in refusal
    assert check(table, rig(accept_without=("torque_feedback",))).refusals == ()


def test_eds_of_another_drive(check, rig):
    assert check(COMPLETE, rig(vendor_id=0x9A, product_code=7)).refusals == ()
    (refusal,) = check(COMPLETE, rig(vendor_id=0xFB)).refusals
    assert "another drive" in refusal
    assert "cia402.vendor_id is 0x000000FB" in refusal
    (refusal,) = check(COMPLETE, rig(product_code=8)).refusals
    assert "cia402.product_code is 0x00000008" in refusal


def test_reaction_to_a_lost_connection_may_be_missing(check, rig):
    assert check(without("1029:1"), rig()).refusals == ()
    (refusal,) = check(without("1029:1"), rig(communication_error_option=1)).refusals
    assert "1029:1" in refusal


def test_a_bit_rate_unknown_to_the_drive(check, rig, shipped):
    slower = replace(rig(), can=replace(shipped.can, bitrate_bit_s=800_000))
    (refusal,) = check(COMPLETE, slower).refusals
    assert "no bit rate of 800 kbit/s" in refusal
    assert "1000 kbit/s" in refusal


def test_write_only_and_out_of_limits_is_doubtful(check, rig):
    assert by_address(check(changed("6060", "i8 wo 0")))["6060"].grade is Grade.DOUBT
    text = eds_text(COMPLETE).replace("[6072]", "[6072]\nHighLimit=1000")
    found = check(text, rig())
    assert found.refusals == ()
    assert by_address(found)["6072"].grade is Grade.DOUBT
    assert "takes anything to 1000, not 1800" in by_address(found)["6072"].consequence


def test_each_sentence_names_its_object_and_ends(check):
    suitability = check("6040 u16 rw 0")
    assert len(suitability.refusals) >= len(CORE_REQUIREMENTS) - 1
    for finding in suitability.findings:
        assert finding.consequence == "" or finding.consequence.endswith(".")
        assert bool(finding.consequence) or finding.grade in (
            Grade.FITS,
            Grade.SUBSTITUTED,
            Grade.ASK,
        )
    assert requirement(0x6071).name in " ".join(suitability.refusals)
