"""Files with everyday mistakes: each is read right or refused with line or channel."""

import numpy as np
import pytest
from everyday_files import everyday_file

from analysis.exchange import ExchangeError, import_record
from rigd.session import read_session
from rigd.session.layout import Status

pytest.importorskip("nptdms", reason="TDMS needs npTDMS")
pytest.importorskip("pyuff", reason="UFF58 needs pyuff")
pytest.importorskip("h5py", reason="MATLAB 7.3 is read if h5py is there")

SAMPLE = range(28)
ALL = range(28, 308)


def wrong_values(made, session):
    """Return the part of a session that differs from the measurement, "" if none."""
    samples = session.samples
    rate_hz = float(session.metadata["rate_hz"])
    if abs(rate_hz / made.rate_hz - 1) > 1e-4:
        return f"rate {rate_hz} and not {made.rate_hz} Hz"
    ticks = np.arange(len(made.angle_rad)) if made.ticks is None else made.ticks
    shift_s = float(session.metadata["torque_delay_s"]) - float(session.metadata["angle_delay_s"])
    torque_first = samples["tick"][0] - round(shift_s * rate_hz)
    found = samples["tick"].astype(int)
    stale = samples["status"] & (Status.ANGLE_STALE | Status.WRENCH_STALE)
    for skip in range(40):  # samples before the channels' common beginning
        expected_ticks = found + skip
        if expected_ticks[-1] > ticks[-1] or not np.isin(expected_ticks, ticks).all():
            continue
        good = stale == 0
        angle_error = np.abs(samples["angle_rad"] - made.angle_rad[expected_ticks])[good].max()
        torque_error = np.abs(samples["coupling_torque_nm"] - made.torque_nm[expected_ticks])[
            good
        ].max()
        if angle_error <= made.digits and torque_error <= made.digits:
            missing = len(ticks) - len(expected_ticks) - skip
            allowed = 2 + np.ceil(made.torque_later)
            if skip > allowed or missing > allowed:
                return f"{skip} samples at the beginning and {missing} at the end are missing"
            late = made.torque_later - round(made.torque_later)
            if abs(shift_s * rate_hz + late) > 0.01:
                return f"delay {shift_s * rate_hz} and not {-late} periods"
            assert torque_first <= found[0] + 1
            return ""
    return "the values are others, or angle and torque do not belong together"


def check(folder, make_plan, seed):
    made = everyday_file(folder, seed)
    path = folder / "session.mcap"
    try:
        done = import_record(made.path, path, make_plan(**made.plan))
    except ExchangeError as error:
        message = str(error)
        assert message.startswith(str(made.path)), message
        assert made.must != "read", f"{made.story}: {message}"
        own = message.removeprefix(str(made.path))
        assert any(name in own for name in made.names), f"{made.story}: {message}"
        assert sorted(each.name for each in folder.iterdir()) == [made.path.name]
        return "refused"
    wrong = wrong_values(made, read_session(path))
    assert not wrong, f"{made.story}: {wrong}; {done.warnings}"
    assert made.must != "refuse", f"{made.story}: was read; {done.warnings}"
    return "read"


# pyuff leaves files open when it writes binary data.
pytestmark = [
    pytest.mark.filterwarnings("ignore::pytest.PytestUnraisableExceptionWarning"),
    pytest.mark.filterwarnings("ignore::ResourceWarning"),
]


@pytest.mark.parametrize("seed", SAMPLE)
def test_everyday_file_is_read_correctly_or_refused(tmp_path, make_plan, seed):
    check(tmp_path, make_plan, seed)


@pytest.mark.slow
def test_everyday_files_are_read_correctly_or_refused(tmp_path, make_plan):
    counts = {"read": 0, "refused": 0}
    wrong = []
    for seed in ALL:
        folder = tmp_path / str(seed)
        folder.mkdir()
        try:
            counts[check(folder, make_plan, seed)] += 1
        except AssertionError as error:
            wrong.append(f"{seed}: {error}")
    assert not wrong, "\n".join(wrong)
    assert min(counts.values()) > 80  # neither refuses everything nor reads everything
