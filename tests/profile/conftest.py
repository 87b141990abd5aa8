import pytest

from rigd.profile import Profile, ProfileError, load_profile


@pytest.fixture
def loaded(tmp_path):
    """Load the text of a profile."""

    def load(text: str) -> Profile:
        path = tmp_path / "a.toml"
        path.write_text(text, encoding="utf-8")
        return load_profile(path)

    return load


@pytest.fixture
def complaints_of(tmp_path):
    """Change the text of a profile, load it, and return the lines of the complaint."""

    def attempt(text: str, *changes: tuple[str, str]) -> list[str]:
        for old, new in changes:
            assert old in text
            text = text.replace(old, new, 1)
        path = tmp_path / "rig.toml"
        path.write_text(text, encoding="utf-8")
        with pytest.raises(ProfileError) as caught:
            load_profile(path)
        lines = str(caught.value).splitlines()
        assert all(line.startswith(f"{path}: ") for line in lines)
        return [line.removeprefix(f"{path}: ") for line in lines]

    return attempt
