"""The state of a session at a glance."""

import pytest

from rigd.view import Health, Scene

pytestmark = pytest.mark.process

WELL = Health(
    missed_ticks=0, late_ticks=0, lost_ticks=0, recorder_lag_ticks=17, disk_free_mb=51_234.0,
    view_dropped=0, bus_load_percent=31.4, bus_errors=0, sensor_status=0, rate_hz=1000.0,
)  # fmt: skip


def rows(text: str) -> dict[str, str]:
    """Return the cells by name, of a table as Markdown has it."""
    lines = [[cell.strip() for cell in line.strip("|").split("|")] for line in text.splitlines()]
    assert {len(line) for line in lines} == {2}
    assert lines[1] == ["---", "---"]
    return dict([lines[0], *lines[2:]])


@pytest.fixture
def summary(description, shown):
    """Return the text that is shown of a reading of the health."""

    def text(t_ns, health):
        found = shown(Scene(description).health_drawings(t_ns, health))
        return found["/summary"].last("TextDocument:text")

    return text


def test_summary_of_a_normal_session(summary):
    assert rows(summary(43_200_000_000, WELL)) == {
        "session": "43 of 136 s",
        "rate": "1000.0 Hz",
        "missed ticks": "0",
        "late ticks": "0",
        "lost ticks": "0",
        "recorder backlog": "17 samples",
        "dropped by the viewer": "0 samples",
        "bus load": "31 %",
        "bus errors": "0",
        "sensor status": "OK",
        "free on the disk": "51.2 GB",
    }


def test_errors_are_highlighted(summary):
    found = rows(summary(0, Health(missed_ticks=3, lost_ticks=0, bus_errors=2, sensor_status=0x41)))
    assert {name for name, text in found.items() if "⚠" in text} == {
        "missed ticks",
        "bus errors",
        "sensor status",
    }
    assert "0x0041" in found["sensor status"]
    assert "3" in found["missed ticks"]


def test_unknown_values_are_left_out(summary):
    assert set(rows(summary(0, Health()))) == {"session"}
