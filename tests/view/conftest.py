"""Output of drawings, read back from a file of Rerun's."""

from dataclasses import dataclass, field

import numpy as np
import pytest
from rerun_files import batches

from rigd.beam import Beam, Damping
from rigd.session.layout import TIMING_SIZE, decode_timings, pack_timing_into
from rigd.view import Scene, SessionDescription
from rigd.view.plots import TIMELINE


@pytest.fixture(autouse=True)
def strict():
    """Errors that Rerun otherwise only logs."""
    import rerun as rr

    before = rr.strict_mode()
    rr.set_strict_mode(True)
    yield
    rr.set_strict_mode(before)


@pytest.fixture
def drawn(tmp_path):
    """Execute drawings; return the recorded batches by entity, not always in order of time."""

    def draw(drawings) -> dict[str, list]:
        import rerun as rr

        path = tmp_path / "drawn.rrd"
        path.unlink(missing_ok=True)
        stream = rr.RecordingStream("rigd")
        stream.save(path)
        for drawing in drawings:
            drawing(stream)
        stream.flush(timeout_sec=60.0)
        stream.disconnect()
        return batches(path)

    return draw


@dataclass
class Shown:
    """Data sent to one entity: of each component its values by time, timeless ones first."""

    times_ns: dict[str, list] = field(default_factory=dict)
    values: dict[str, list] = field(default_factory=dict)
    kinds: dict[str, str] = field(default_factory=dict)
    batches: int = 0

    def add(self, batch) -> None:
        self.batches += 1
        times_ns = [None] * batch.num_rows
        if TIMELINE in batch.schema.names:
            times_ns = batch.column(TIMELINE).cast("int64").to_pylist()
        for entry in batch.schema:
            kind = (entry.metadata or {}).get(b"rerun:component_type")
            if kind is not None:
                self.kinds[entry.name] = kind.decode()
                rows = zip(times_ns, batch.column(entry.name).to_pylist(), strict=True)
                self._add(entry.name, [row for row in rows if row[1] is not None])

    def _add(self, name: str, rows: list) -> None:
        # Of one time the earlier batch comes first: Rerun may split the data at any row.
        rows = [*zip(self.times_ns.get(name, []), self.values.get(name, []), strict=True), *rows]
        rows.sort(key=lambda row: -1 if row[0] is None else row[0])
        self.times_ns[name] = [time_ns for time_ns, _ in rows]
        self.values[name] = [value for _, value in rows]

    def last(self, name: str):
        """The newest value of a component that has but one a time."""
        (value,) = self.values[name][-1]
        return value


@pytest.fixture
def shown(drawn):
    """Execute drawings; return the recorded data by entity."""

    def draw(drawings) -> dict[str, Shown]:
        found = {}
        for entity, written in drawn(drawings).items():
            found[entity] = Shown()
            for batch in written:
                found[entity].add(batch)
        return found

    return draw


class _LayoutReader:
    """A stream that stores the layout sent to it and drops everything else."""

    layout = None

    def send_blueprint(self, blueprint):
        self.layout = blueprint

    def __getattr__(self, _name):
        return lambda *_, **__: None


@pytest.fixture
def layout_of(description):
    """Return the root of the layout that a scene sends to a new connection."""

    def taken(of=description):
        stream = _LayoutReader()
        for drawing in Scene(of).initial_drawings():
            drawing(stream)
        return stream.layout.root_container

    return taken


@pytest.fixture
def make_timings():
    """Make ages of readings (n,) at 1 kHz, of angle and wrench in s."""

    def make(n: int, angle_age_s: float = 0.0, wrench_age_s: float = 0.0) -> np.ndarray:
        block = bytearray(n * TIMING_SIZE)
        for tick in range(n):
            offset = tick * TIMING_SIZE
            pack_timing_into(block, offset, tick * 1_000_000, tick, angle_age_s, wrench_age_s)
        return decode_timings(block)

    return make


@pytest.fixture
def description():
    """The paper's antenna and session."""
    return SessionDescription(
        name="20261121-101500-chirp",
        rate_hz=1000.0,
        scheduled_ticks=136_000,
        sweep=(1000, 121_000),
        beam=Beam(0.98, 4.7e-3, 0.090275),
        damping=Damping(7.1e-5, 0.996, 5.5e-2, 0.594),
    )
