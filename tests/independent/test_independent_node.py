"""rigd against an independent drive, made from EDS files of different restrictions.

The whole of it, with files of real drives, is `run_public_eds.py`.
"""

import importlib.util
import sys
from pathlib import Path

import pytest
from cases import further

pytestmark = pytest.mark.process

HERE = Path(__file__).parent


def load(name):
    """Load a module of this folder by the name by which the others import it."""
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, HERE / f"{name}.py")
        module = sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
    return sys.modules[name]


@pytest.fixture(scope="module")
def trial():
    before, path = set(sys.modules), list(sys.path)
    yield load("run_public_eds")
    sys.path[:] = path
    for name in ("run_public_eds", "scene", "seqpacket_bus", "eds_text"):
        if name not in before:
            sys.modules.pop(name, None)


@pytest.fixture
def eds_file(tmp_path):
    def write(**changes) -> Path:
        path = tmp_path / "drive.eds"
        path.write_text(load("eds_text").eds_text(**changes), encoding="utf-8")
        return path

    return write


RESTRICTED = {"x60E0": (6, "ro", 50000), "x60E1": (6, "ro", 50000), "x1800_3": (6, "rw", 100)}
"""Limits that cannot be written but do not cut, and 10 ms between two TPDOs from before."""
SPARSE = ("1005", "1006", "1007", "1019", "1029", "1400:5", "60B2", "60C2", "60E0", "60E1")


# As in tests/wire/test_drives_by_eds.py for the simulated drive; the rest is of this one.
@pytest.mark.slow
def test_session_fault_reset_session(trial, eds_file):
    # The machine that runs tests has other things to do.
    verdict = trial.play("drive", eds_file(**RESTRICTED), left_on=(), ignore_timing=True)
    assert verdict.paper.usable, verdict.paper.why
    assert verdict.paper.accept == []
    assert not verdict.errors
    assert verdict.steps["chirp again"] == "ok"


@pytest.mark.parametrize(
    ("without", "accepted"),
    [
        # As tests/devices/cia402 has it of a drive by script.
        further((*SPARSE, "6072"), ["torque_limit"], id="sparse"),
        pytest.param(
            *(("1016",), []), id="deadline of the RPDO for a heartbeat", marks=pytest.mark.slow
        ),
    ],
)
def test_session_on_a_drive_without_optional_objects(trial, eds_file, without, accepted):
    path = eds_file(without=without)
    paper = trial.on_paper(path)
    assert paper.usable, paper.why
    assert paper.accept == accepted
    with trial.Scene(path, profile=trial.profile_for(paper, path)) as scene:
        done = scene.chirp()
        state = scene.state()
    assert trial.complete(done) == "ok"
    assert (state["state"], state["per_mille"]) == ("switch-on disabled", 0)


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        # Each is refused of a drive by script as well, in tests/devices/cia402.
        pytest.param({"x6502": (7, "ro", 0x1A5)}, "6502", marks=pytest.mark.slow),
        pytest.param({"without": ("6071",)}, "6071", marks=pytest.mark.slow),
        further({"without": ("1016", "1400:5")}, "1016"),
    ],
)
def test_unusable_drive_is_refused_with_the_object(trial, eds_file, changes, named):
    path = eds_file(**changes)
    paper = trial.on_paper(path)
    with trial.Scene(path, profile={"cia402.eds": str(path)}) as scene:
        done = scene.chirp()
        states = [entry["state"] for entry in scene.log("state")]
    assert named in paper.why or named in str(paper.accept) or "watchdog" in paper.accept
    assert done.code == 1
    assert named in done.last
    assert "operation enabled" not in states


@pytest.mark.parametrize("how", [further("abort"), further("keeps on"), "ignored"])
def test_reset_switches_off_a_drive_that_a_killed_host_left_on(trial, eds_file, how):
    result = trial.play_left_on(eds_file(), how, None)
    assert result.startswith("ok: off"), result


@pytest.mark.further  # by script in tests/devices/cia402/test_cia402_setup.py
def test_reset_reports_a_drive_that_does_not_switch_off(trial, eds_file):
    """A drive that takes no controlword by SDO: nothing but its STO is left."""
    path = eds_file(x6040=(6, "ro", 0))
    with trial.Scene(path, node={"pre_operational": "ignored"}) as scene:
        scene.order(do="leave on", per_mille=150)
        done = scene.reset()
        state = scene.state()
    assert state["per_mille"] == 150
    assert done.code == 1
    assert "next session can be started" not in done.printed
    assert "Traceback" not in done.printed


@pytest.mark.further  # a rule of this folder's own node
def test_the_node_enforces_the_rules_of_pdos(trial, eds_file):
    """Errors of a master that sets PDOs up in the wrong order."""
    import can
    import canopen

    path = eds_file()
    with trial.Scene(path) as scene:
        bus = load("seqpacket_bus").SeqpacketBus(str(scene.folder / "bus"))
        network = canopen.Network(bus)
        network.connect()
        try:
            node = network.add_node(5, str(path))

            def refusal(index, sub, value) -> int:
                with pytest.raises(canopen.SdoAbortedError) as caught:
                    node.sdo[index][sub].raw = value
                return caught.value.code

            assert refusal(0x1A00, 0, 0) == 0x08000022, "the PDO is enabled"
            node.sdo[0x1800][1].raw = 0x80000185
            node.sdo[0x1A00][0].raw = 0
            assert refusal(0x1A00, 1, 0x60710000) == 0x06040041, "of no length"
            assert refusal(0x1A00, 1, 0x60FF0020) == 0x06040041, "not there"
            node.sdo[0x1A00][1].raw = 0x60640020
            node.sdo[0x1A00][0].raw = 1
            assert refusal(0x1A00, 1, 0x60410010) == 0x08000022, "the count is not 0"
            node.sdo[0x1016][1].raw = 0x7F0064
            assert refusal(0x1016, 2, 0x7F0064) == 0x06040043, "the same node twice"
            with pytest.raises(canopen.SdoAbortedError):
                node.sdo[0x6041].raw = 1
            node.sdo[0x1800][2].raw = 1
            node.sdo[0x1800][1].raw = 0x185
            received: list[can.Message] = []
            network.subscribe(0x185, lambda can_id, data, at: received.append(bytes(data)))
            node.nmt.state = "OPERATIONAL"
            network.sync.transmit()
            deadline = 200
            while not received and deadline:
                node.sdo[0x6041].raw  # noqa: B018, one turn of the bus
                deadline -= 1
            assert received == [bytes(4)]
        finally:
            network.disconnect()


@pytest.mark.further  # as its other rules
def test_silent_master_switches_torque_off(trial, eds_file):
    """1016 and 6007 of the node act by themselves, on the time that is written there."""
    import canopen

    path = eds_file()
    with trial.Scene(path) as scene:
        network = canopen.Network(load("seqpacket_bus").SeqpacketBus(str(scene.folder / "bus")))
        network.connect()
        try:
            node = network.add_node(5, str(path))
            node.sdo[0x1016][1].raw = 0x7F0064
            scene.order(do="leave on", per_mille=100)
            network.send_message(0x77F, b"\x05")
            deadline = 2000
            while scene.state()["per_mille"] and deadline:
                deadline -= 1
        finally:
            network.disconnect()
        lost = scene.log("connection lost")
        off = [entry for entry in scene.log("torque") if not entry["enabled"]]
    assert [entry["code"] for entry in lost] == [0x8130]
    assert off[-1]["per_mille"] == 0
