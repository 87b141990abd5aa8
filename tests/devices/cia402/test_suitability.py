"""Can a drive be used? What its EDS is held against, and what is said of it."""

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
def judged(tmp_path):
    """Judge a drive by the table of its objects, or by the text of its file."""

    def judged(table, rig=None):
        path = tmp_path / "drive.eds"
        path.write_text(table if table.startswith("[") else eds_text(table))
        return check_suitability(read_eds(path), rig)

    return judged


def by_place(judgement):
    return {finding.what.split()[0]: finding for finding in judgement.findings}


def test_a_complete_drive_fits(judged, rig):
    for judgement in (judged(COMPLETE), judged(COMPLETE, rig())):
        assert judgement.refusals == ()
        grades = {f.what: f.grade for f in judgement.findings}
        assert set(grades.values()) == {Grade.FITS, Grade.SUBSTITUTED}
        # Every object of the table is told of, but for the identity and what is told in words.
        assert len(grades) == len(CORE_REQUIREMENTS) + len(OPTIONAL_REQUIREMENTS) - 4 + 5


@pytest.mark.parametrize("name", WITH_TORQUE)
def test_drives_with_torque_mode_are_not_refused(name):
    judgement = check_suitability(read_eds(eds_path(name)))
    assert judgement.refusals == ()
    mode = by_place(judgement)["6502"]
    told = name in ("e35", "epos4_0110")
    assert mode.grade is (Grade.FITS if told else Grade.ASK)


@pytest.mark.parametrize(
    ("name", "modes"),
    list(zip(WITHOUT_TORQUE, ("0x6D", "0x43", "0x63", "0xA5", "0x1F0065"), strict=True)),
)
def test_drives_without_it_are_refused_by_its_name(name, modes):
    first = check_suitability(read_eds(eds_path(name))).refusals[0]
    assert first.startswith("No cyclic synchronous torque mode: object 6502 = ")
    assert f"{modes} lacks bit 9" in first


def test_what_the_two_real_drives_lack(rig):
    elmo = by_place(check_suitability(read_eds(eds_path("elmo_gold")), rig()))
    for place in ("60E0", "60E1"):
        assert elmo[place].grade is Grade.FITS
        assert elmo[place].found == "ro, 50000: it does"
        assert elmo[place].wanted == "at least 1800"
    assert not [f for f in elmo.values() if f.grade is Grade.REFUSED]

    epos = read_eds(eds_path("epos4_0170"))
    (refusal,) = check_suitability(epos, rig()).refusals
    assert "6072 (Max torque)" in refusal
    assert 'cia402.accept_without = ["torque_limit"]' in refusal
    accepted = by_place(check_suitability(epos, rig(accept_without=("torque_limit",))))
    assert accepted["6072"].grade is Grade.ACCEPTED
    assert accepted["1006"].grade is Grade.SUBSTITUTED
    assert not [f for f in accepted.values() if f.grade is Grade.REFUSED]


@pytest.mark.parametrize("needed", CORE_REQUIREMENTS, ids=lambda needed: needed.address)
def test_what_is_core_and_missing_is_refused_by_its_name(judged, needed):
    place = f"{needed.index:04X}:{needed.sub}"
    found = judged(without(place if f"{place} " in COMPLETE else needed.address))
    (refusal,) = found.refusals
    assert needed.address in refusal
    if needed.index == 0x6502:
        assert refusal == "No cyclic synchronous torque mode: object 6502 is missing."
    else:
        assert f"({needed.name})" in refusal


@pytest.mark.parametrize("modes", ["-", "0"])
def test_a_file_that_does_not_tell_the_modes_leaves_it_to_the_drive(judged, modes):
    found = judged(changed("6502", f"u32 ro {modes}"))
    assert found.refusals == ()
    assert by_place(found)["6502"].grade is Grade.ASK
    assert "the drive will be asked" in by_place(found)["6502"].found


def test_a_mode_that_cannot_be_set_is_none(judged):
    table = eds_text(changed("6502", "u32 ro -")).replace(
        "[6060]", "[6060]\nLowLimit=-1\nHighLimit=9"
    )
    (refusal,) = judged(table).refusals
    assert "6060 (Modes of operation) takes -1 to 9, not 10" in refusal
    # Limits that make no sense are none.
    table = table.replace("HighLimit=9", "HighLimit=-5")
    assert judged(table).refusals == ()


@pytest.mark.parametrize(
    ("place", "line", "words"),
    [
        ("6071", "i16 rww 0", "cannot be mapped into a PDO"),
        ("6064", "i16 ro 0 *", "has 16 bits, not 32"),
        ("6040", "u16 ro 0 *", "is read-only and does not hold what is needed"),
        ("1600:0", "u8 ro 1", "is read-only and does not hold"),
        ("1800:2", "u8 ro 255", "is read-only and does not hold what is needed (1)"),
        ("1400:1", "u32 ro 0x80000201", "is read-only and does not hold what is needed (0x201)"),
        ("60B2", "i16 ro 5 *", "is read-only and does not hold what is needed (0)"),
        ("1800:3", "u16 ro 10", "is read-only and does not hold what is needed (0)"),
    ],
)
def test_what_cannot_be_used_is_refused(judged, place, line, words):
    (refusal,) = judged(changed(place, line)).refusals
    assert place.removesuffix(":0") in refusal
    assert words in refusal


@pytest.mark.parametrize(
    ("place", "line", "found"),
    [
        ("1005", "u32 const 0x80", "const, 0x80: it does"),
        ("1014", "u32 const $NODEID+0x80", "const, 0x81: it does"),
        ("60B2", "i16 ro 0 *", "ro, 0: it does"),
        ("1400:2", "u8 ro -", "ro: the drive will be asked"),
    ],
)
def test_what_is_read_only_may_hold_what_is_needed(judged, place, line, found):
    judgement = judged(changed(place, line))
    assert judgement.refusals == ()
    assert by_place(judgement)[place].found == found


def test_pdos_that_are_mapped_as_needed_once_and_for_all(judged):
    fixed = (
        COMPLETE.replace("1600:0 u8 rw 1", "1600:0 u8 const 2")
        .replace("1600:1 u32 rw", "1600:1 u32 const")
        .replace("1600:2 u32 rw 0", "1600:2 u32 const 0x60710010")
    )
    judgement = judged(fixed)
    assert judgement.refusals == ()
    assert by_place(judgement)["1600"].found == "const, 2: it does"
    always_on = fixed.replace("1400:1 u32 rw", "1400:1 u32 const")
    assert by_place(judged(always_on))["1400:1"].found == "const, 0x201: it does"
    (refusal,) = judged(changed("1400:1", "u32 const 0x201")).refusals
    assert "1400:1 (COB-ID of RPDO1) is read-only" in refusal
    (refusal,) = judged(fixed.replace("0x60710010", "0x60FF0020")).refusals
    assert "1600 (Mapping of RPDO1) is read-only" in refusal


def test_what_a_mapping_has_already_can_be_mapped(judged):
    table = changed("6040", "u16 rww 0")
    assert judged(table).refusals == ()


def test_what_is_write_only_is_doubtful_where_it_is_set_anyway_and_refused_elsewhere(judged, rig):
    mode = by_place(judged(changed("6060", "i8 wo -"), rig()))["6060"]
    assert mode.grade is Grade.DOUBT
    assert "write-only" in mode.sentence
    (refusal,) = judged(changed("60B2", "i16 wo -"), rig()).refusals
    assert "60B2" in refusal
    assert "write-only" in refusal


def test_no_watchdog_goes_missing_silently(judged, rig):
    bare = without("1016:1")
    warned = by_place(judged(bare))["watchdog"]
    assert warned.grade is Grade.DOUBT
    assert warned.accept == "watchdog"
    (refusal,) = judged(bare, rig()).refusals
    assert "1016:1" in refusal
    assert 'cia402.accept_without = ["watchdog"]' in refusal
    assert len(judged(bare, rig(accept_without=("torque_limit",))).refusals) == 1
    accepted = by_place(judged(bare, rig(accept_without=("watchdog",))))["watchdog"]
    assert accepted.grade is Grade.ACCEPTED
    for table, values, words in (
        (bare + "\n1400:5 u16 rw 0", {}, "deadline of the RPDO"),
        (bare, {"own_watchdog_s": 0.1}, "own watchdog"),
    ):
        stands = by_place(judged(table, rig(**values)))["watchdog"]
        assert stands.grade is Grade.SUBSTITUTED
        assert words in stands.found
    # What the drive does on a lost connection is then its maker's choice anyway.
    for values in ({"own_watchdog_s": 0.1}, {"accept_without": ("watchdog",)}):
        assert judged(without("1016:1", "6007"), rig(**values)).refusals == ()
    assert len(judged(without("6007"), rig()).refusals) == 1
    read_only = judged(changed("1016:1", "u32 ro 0"), rig())
    assert len(read_only.refusals) == 1


@pytest.mark.parametrize(
    ("place", "key"), [("6080", "max_speed_rad_s"), ("6076", "rated_torque_unit_nm")]
)
def test_what_the_profile_asks_for_must_be_there(judged, rig, place, key):
    assert judged(without(place)).refusals == ()
    (refusal,) = judged(without(place), rig()).refusals
    assert f"cia402.{key} = 0" in refusal
    assert judged(without(place), rig(**{key: 0.0})).refusals == ()


def test_an_actual_torque_that_cannot_be_mapped_may_be_accepted(judged, rig):
    table = changed("6077", "i16 ro 0")
    (refusal,) = judged(table, rig()).refusals
    assert 'cia402.accept_without = ["torque_feedback"]' in refusal
    assert judged(table, rig(accept_without=("torque_feedback",))).refusals == ()


def test_a_file_of_another_drive(judged, rig):
    assert judged(COMPLETE, rig(vendor_id=0x9A, product_code=7)).refusals == ()
    (refusal,) = judged(COMPLETE, rig(vendor_id=0xFB)).refusals
    assert "another drive" in refusal
    assert "cia402.vendor_id is 0x000000FB" in refusal
    (refusal,) = judged(COMPLETE, rig(product_code=8)).refusals
    assert "cia402.product_code is 0x00000008" in refusal


def test_what_a_lost_connection_is_to_do_can_be_set_only_where_it_is_there(judged, rig):
    assert judged(without("1029:1"), rig()).refusals == ()
    (refusal,) = judged(without("1029:1"), rig(communication_error_option=1)).refusals
    assert "1029:1" in refusal


def test_a_bit_rate_that_the_drive_has_not(judged, rig, shipped):
    slower = replace(rig(), can=replace(shipped.can, bitrate_bit_s=800_000))
    (refusal,) = judged(COMPLETE, slower).refusals
    assert "no bit rate of 800 kbit/s" in refusal
    assert "1000 kbit/s" in refusal


def test_write_only_and_out_of_limits_is_doubtful(judged, rig):
    assert by_place(judged(changed("6060", "i8 wo 0")))["6060"].grade is Grade.DOUBT
    text = eds_text(COMPLETE).replace("[6072]", "[6072]\nHighLimit=1000")
    found = judged(text, rig())
    assert found.refusals == ()
    assert by_place(found)["6072"].grade is Grade.DOUBT
    assert "takes anything to 1000, not 1800" in by_place(found)["6072"].sentence


def test_each_sentence_names_its_object_and_ends(judged):
    judgement = judged("6040 u16 rw 0")
    assert len(judgement.refusals) >= len(CORE_REQUIREMENTS) - 1
    for finding in judgement.findings:
        assert finding.sentence == "" or finding.sentence.endswith(".")
        assert bool(finding.sentence) or finding.grade in (
            Grade.FITS,
            Grade.SUBSTITUTED,
            Grade.ASK,
        )
    assert requirement(0x6071).name in " ".join(judgement.refusals)
