"""Other values in the text of a profile: comments stay, and the values are the new ones."""

import pytest

from rigd.profile import ProfileError, check_new, load_profile, write_new
from rigd.profile._write import Setting, with_head, with_settings


@pytest.fixture(scope="module")
def shipped():
    return load_profile("antenna_can")


@pytest.mark.parametrize(
    ("setting", "line"),
    [
        (Setting("description", 'a "b" \\ é'), 'description = "a \\"b\\" \\\\ é"'),
        (
            Setting("cia402.vendor_id", 0x9A, "datasheet", is_hexadecimal=True),
            'vendor_id = { value = 0x0000009A, source = "datasheet" }',
        ),
        (
            Setting("motor.peak_torque_nm", 1.25, "measured"),
            'peak_torque_nm = { value = 1.25, source = "measured" }',
        ),
        (Setting("cia402.accept_without", ("watchdog",)), 'accept_without = ["watchdog"]'),
        (Setting("cia402.sync_gaps", False), "sync_gaps = false"),
    ],
)
def test_a_value_replaces_that_of_its_key(loaded, shipped, setting, line):
    text = with_settings(shipped.text, [setting])
    old, new = shipped.text.splitlines(), text.splitlines()
    assert len(old) == len(new)
    ((_, after),) = [pair for pair in zip(old, new, strict=True) if pair[0] != pair[1]]
    assert after == line
    profile = loaded(text)
    section, _, key = setting.profile_key.rpartition(".")
    found = getattr(getattr(profile.rig, section), key) if section else profile.description
    assert found == setting.new_value


def test_reasons_become_comments_above(loaded, shipped):
    text = with_settings(shipped.text, [Setting("cia402.node_id", 7, comment="Because. " * 20)])
    lines = text.splitlines()
    index = lines.index('node_id = { value = 7, source = "assumed" }')
    assert lines[index - 1].startswith("# Because.")
    assert max(map(len, lines[index - 3 : index])) <= 100
    assert loaded(text).rig.cia402.node_id == 7


def test_a_new_key_comes_first_in_its_section(shipped):
    without_acceptance = "\n".join(
        line for line in shipped.text.splitlines() if "accept_without" not in line
    )
    text = with_settings(without_acceptance, [Setting("cia402.accept_without", ("torque_limit",))])
    lines = text.splitlines()
    assert lines[lines.index("[cia402]") + 1] == 'accept_without = ["torque_limit"]'
    with pytest.raises(KeyError):
        with_settings("name = 'x'\n", [Setting("cia402.node_id", 1)])


def test_another_head(loaded, shipped):
    text = with_head(shipped.text, ["One line.", "", "* another"])
    assert text.startswith('# One line.\n#\n# * another\n\nname = "antenna_can"')
    assert loaded(text).rig == shipped.rig


def test_only_new_files_are_written(tmp_path):
    path = tmp_path / "a.toml"
    check_new(path)
    write_new(path, "one")
    with pytest.raises(ProfileError, match="exists and is not overwritten"):
        write_new(path, "two")
    with pytest.raises(ProfileError, match="exists and is not overwritten"):
        check_new(path)
    assert path.read_text() == "one"
    with pytest.raises(ProfileError, match="cannot be written"):
        write_new(tmp_path / "none" / "b.toml", "x")
