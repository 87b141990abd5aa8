"""Address of a running ``rigd simulate``: one small file for each simulated rig.

A simulated rig replaces the hardware of one profile. Code that opens the devices of a profile
checks here first, so that a motor never moves where a simulation was meant.
"""

import json
import socket
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rigd.devices.contracts import DeviceError
from rigd.runtime.addresses import announce as write_address
from rigd.runtime.addresses import answers, read_address, runtime_folder
from rigd.runtime.processes import listening_sockets

if TYPE_CHECKING:  # numpy, which it brings, takes longer than a stop may
    from rigd.devices.parameters import RigParameters

_LONGEST_LINE = 65_536
_TIMEOUT_S = 2.0


@dataclass(frozen=True, slots=True)
class SimulatorAddress:
    """Address of a simulated rig."""

    pid: int
    """Its process."""
    control_socket: str
    """Unix socket that takes faults to inject; as long as it answers, the simulator runs."""
    can_socket: str = ""
    """Unix socket that carries CAN frames; empty where it sits on a real (virtual) CAN bus."""
    serial_port: str = ""
    """Pseudo-terminal of the serial sensor; empty where it has none."""
    lock_step: bool = False
    """It advances one period per SYNC instead of by the clock."""
    rig: Mapping[str, object] = field(default_factory=dict)
    """What it simulates: the rig's parameters by dotted key, as `described` gives them."""


def described(rig: "RigParameters") -> dict[str, object]:
    """Return a rig's parameters by dotted key, as JSON has them."""
    return json.loads(json.dumps(dict(_flat(asdict(rig), ""))))  # type: ignore[no-any-return]


def differences(rig: "RigParameters", simulator: SimulatorAddress) -> list[str]:
    """List the differences of the simulated rig from a profile's: one phrase per key.

    The seed of the noise is none: each session has its own.

    Parameters
    ----------
    rig
        Parameters of the profile.
    simulator
        Address of the simulated rig.
    """
    ours, theirs = described(rig), simulator.rig
    return [
        f"{key} = {_shown(theirs[key])} instead of {_shown(value)}"
        for key, value in ours.items()
        if key in theirs and theirs[key] != value and key != "simulation.seed"
    ]


def announce(rig_name: str, address: SimulatorAddress) -> Path:
    """Write down where the simulator of a rig is, until `forget`; return the file.

    Parameters
    ----------
    rig_name
        Name of the profile that it replaces.
    address
        Where it is.
    """
    path = _address_file(rig_name)
    write_address(path, asdict(address))
    return path


def forget(rig_name: str) -> None:
    """Take the address of a simulator away, its own or what a dead one left."""
    _address_file(rig_name).unlink(missing_ok=True)


def find_simulator(rig_name: str) -> SimulatorAddress | None:
    """Return the running simulator of a rig, or None; what a dead one left is not one."""
    try:
        address = SimulatorAddress(**read_address(_address_file(rig_name)))
    except TypeError:  # it has other members
        return None
    found = isinstance(address.control_socket, str) and answers(address.control_socket)
    return address if found else None


def ask_simulator(address: SimulatorAddress, request: dict[str, Any]) -> dict[str, Any]:
    """Send a request to a running simulator, and return its reply.

    Parameters
    ----------
    address
        Address of the simulator.
    request
        The request, by one key: ``inject``, ``status`` or ``renew_noise``.

    Raises
    ------
    DeviceError
        If it does not answer, or refuses; then with its own words.
    """
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link:
            link.settimeout(_TIMEOUT_S)
            link.connect(address.control_socket)
            link.sendall(json.dumps(request).encode() + b"\n")
            with link.makefile("rb") as lines:
                reply = json.loads(lines.readline(_LONGEST_LINE))
    except (OSError, ValueError) as error:
        raise DeviceError(
            f"The simulated rig (process {address.pid}) does not answer ({error}); start it again."
        ) from None
    if not isinstance(reply, dict) or "error" in reply:
        raise DeviceError(str(reply["error"] if isinstance(reply, dict) else reply))
    return reply


def unreachable_simulators(rig_name: str) -> list[Path]:
    """Return the control sockets on which any simulator of a rig listens on this computer.

    The kernel lists them for every user who runs the simulator, and wherever its runtime folder is.
    Ask only if `find_simulator` finds none: those that are listed then cannot be reached from here.
    """
    try:
        return [path for path in listening_sockets() if path.name == f"{rig_name}.control"]
    except OSError:
        return []


def _flat(table: Mapping[str, object], prefix: str) -> Iterator[tuple[str, object]]:
    for key, value in table.items():
        dotted = prefix + key.rstrip("_")
        if isinstance(value, dict):
            yield from _flat(value, dotted + ".")
        else:
            yield dotted, value


def _shown(value: object) -> str:
    return f"{value:g}" if isinstance(value, float) else json.dumps(value)


def _address_file(rig_name: str) -> Path:
    return runtime_folder() / f"{rig_name}.json"
