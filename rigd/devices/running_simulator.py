"""Address of a running ``rigd simulate``: one small file for each simulated rig.

A simulated rig replaces the hardware of one profile. Code that opens the devices of a profile first
checks whether a simulated rig runs, so that a motor never moves when a simulation was intended.
"""

import json
import socket
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rigd.devices.contracts import DeviceError
from rigd.runtime.addresses import read_address, runtime_folder, socket_answers, write_address
from rigd.runtime.processes import listening_sockets

if TYPE_CHECKING:  # it imports numpy, which takes longer than a stop may take
    from rigd.devices.parameters import RigParameters

_MAX_REPLY_BYTES = 65_536
"""Largest length in bytes of a simulator's reply."""
_REPLY_TIMEOUT_S = 10.0
"""Time in seconds to wait for a simulator's reply. A busy computer may take seconds to compute a
beam with a new obstacle."""


@dataclass(frozen=True, slots=True)
class SimulatorAddress:
    """Address of a running simulated rig, as written to its address file."""

    pid: int
    """Number of the simulator's process."""
    control_socket: str
    """Unix socket that accepts faults to inject; while it answers, the simulator runs."""
    can_socket: str = ""
    """Unix socket that carries CAN frames; empty if the simulator uses a CAN interface of the
    kernel."""
    serial_port: str = ""
    """Pseudo-terminal of the simulated serial sensor; empty if there is none."""
    lock_step: bool = False
    """Whether the simulation advances by one period per SYNC instead of in real time."""
    rig: Mapping[str, object] = field(default_factory=dict)
    """Parameters of the simulated rig by dotted key, as returned by `parameters_by_dotted_key`."""


def parameters_by_dotted_key(rig: "RigParameters") -> dict[str, object]:
    """Return a rig's parameters as a flat JSON object, by dotted key."""
    return json.loads(json.dumps(dict(_flatten(asdict(rig), ""))))  # type: ignore[no-any-return]


def profile_differences(rig: "RigParameters", simulator: SimulatorAddress) -> list[str]:
    """Return the differences between a profile and the simulated rig, one phrase per key.

    A different seed of the noise does not count, since each session has its own.

    Parameters
    ----------
    rig
        Parameters of the profile.
    simulator
        Address of the simulated rig.
    """
    own_parameters, simulated_parameters = parameters_by_dotted_key(rig), simulator.rig
    return [
        f"{key} = {_format_value(simulated_parameters[key])} instead of "
        f"{_format_value(profile_value)}"
        for key, profile_value in own_parameters.items()
        if key in simulated_parameters
        and simulated_parameters[key] != profile_value
        and key != "simulation.seed"
    ]


def write_address_file(rig_name: str, simulator_address: SimulatorAddress) -> Path:
    """Write the address file of a simulator, and return its path.

    Parameters
    ----------
    rig_name
        Name of the profile whose hardware the simulator replaces.
    simulator_address
        Address of the simulator.
    """
    address_path = _address_file(rig_name)
    write_address(address_path, asdict(simulator_address))
    return address_path


def remove_address_file(rig_name: str) -> None:
    """Remove the address file of a simulator, also the file of a simulator that was killed."""
    _address_file(rig_name).unlink(missing_ok=True)


def find_simulator(rig_name: str) -> SimulatorAddress | None:
    """Return the address of the running simulator of a rig, or None if none answers."""
    try:
        simulator_address = SimulatorAddress(**read_address(_address_file(rig_name)))
    except TypeError:  # the file has missing or other members
        return None
    is_running = isinstance(simulator_address.control_socket, str) and socket_answers(
        simulator_address.control_socket
    )
    return simulator_address if is_running else None


def ask_simulator(simulator_address: SimulatorAddress, request: dict[str, Any]) -> dict[str, Any]:
    """Send a request to a running simulator, and return its reply.

    Parameters
    ----------
    simulator_address
        Address of the simulator.
    request
        Request with one key: ``inject``, ``status`` or ``renew_noise``.

    Raises
    ------
    DeviceError
        If the simulator does not answer, or refuses; the message is then that of the simulator.
    """
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as control_link:
            control_link.settimeout(_REPLY_TIMEOUT_S)
            control_link.connect(simulator_address.control_socket)
            control_link.sendall(json.dumps(request).encode() + b"\n")
            with control_link.makefile("rb") as reply_lines:
                reply = json.loads(reply_lines.readline(_MAX_REPLY_BYTES))
    except (OSError, ValueError) as error:
        raise DeviceError(
            f"The simulated rig (process {simulator_address.pid}) does not answer ({error}); start "
            "it again."
        ) from None
    if not isinstance(reply, dict) or "error" in reply:
        raise DeviceError(str(reply["error"] if isinstance(reply, dict) else reply))
    return reply


def unreachable_simulator_sockets(rig_name: str) -> list[Path]:
    """Return the control sockets on which simulators of a rig listen on this computer.

    The kernel lists the sockets of all users, in every runtime folder. Call this function only if
    `find_simulator` finds no simulator: this process then cannot reach those that are listed.
    """
    try:
        return [
            socket_path
            for socket_path in listening_sockets()
            if socket_path.name == f"{rig_name}.control"
        ]
    except OSError:
        return []


def _flatten(table: Mapping[str, object], key_prefix: str) -> Iterator[tuple[str, object]]:
    """Yield dotted key and value of each leaf of a nested table."""
    for key, leaf_value in table.items():
        dotted_key = key_prefix + key.rstrip("_")
        if isinstance(leaf_value, dict):
            yield from _flatten(leaf_value, dotted_key + ".")
        else:
            yield dotted_key, leaf_value


def _format_value(value: object) -> str:
    """Format a parameter's value for messages."""
    return f"{value:g}" if isinstance(value, float) else json.dumps(value)


def _address_file(rig_name: str) -> Path:
    """Return the path of a simulator's address file."""
    return runtime_folder() / f"{rig_name}.json"
