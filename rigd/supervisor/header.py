"""What a session's file says of the session, from tick 0 on."""

import json
import platform

from rigd import __version__
from rigd.devices.registry import simulated_differently
from rigd.engine.process import Message
from rigd.supervisor.orders import Order


def file_header(order: Order, connected: Message, tare: Message) -> Message:
    """Return metadata, segments and attachments of a session.

    Parameters
    ----------
    order
        What is run.
    connected
        What the control process told of the devices and of its real-time settings.
    tare
        Metadata of the tare.
    """
    return {
        "metadata": _metadata(order, connected, tare),
        "segments": order.excitation.segments,
        "attachments": {
            "profile.toml": order.profile.text,
            "calibration.json": json.dumps(connected["calibration"], indent=1),
        },
    }


def _metadata(order: Order, connected: Message, tare: Message) -> dict[str, str]:
    rig = order.profile.rig
    metadata = {
        "id": order.path.stem,
        "rate_hz": repr(rig.rate_hz),
        "excitation": order.excitation.kind,
        **{name: _text(value) for name, value in order.excitation.parameters.items()},
        "beam_length_m": repr(rig.beam.length_m),
        "beam_density_kg_per_m": repr(rig.beam.density_kg_per_m),
        "beam_bending_stiffness_n_m2": repr(rig.beam.bending_stiffness_n_m2),
        "tool_inertia_kg_m2": repr(rig.sensor.tool_inertia_kg_m2),
        "angle_delay_s": repr(rig.encoder.delay_s),
        "torque_delay_s": repr(rig.sensor.delay_s),
        "actuation_delay_s": repr(rig.actuation.delay_s),
        "sensor_projection": ",".join(map(repr, rig.sensor.projection)),
        "drive": rig.devices.drive,
        "sensor": rig.devices.sensor,
        "simulated": str(connected["simulated"]).lower(),
        "profile": order.profile.name,
        "software": f"rigd {__version__}",
        "host": platform.node(),
        **{f"realtime_{name}": value for name, value in connected["realtime"].items()},
        **connected.get("drive", {}),
        **tare,
        **dict(order.notes),
    }
    differences = simulated_differently(rig)
    if differences:
        metadata["simulated_differently"] = "; ".join(differences)
    if rig.acquisition is not None:
        metadata["acquisition_mode"] = rig.acquisition.mode
        metadata["acquisition_deadline_s"] = repr(rig.acquisition.deadline_us * 1e-6)
    if rig.ati_serial is not None:
        metadata["sensor_filter"] = rig.ati_serial.filter
        metadata["sensor_filter_delay_s"] = repr(rig.ati_serial.filter_delay_s(rig.rate_hz))
    if rig.sensor.filter_hz > 0:
        metadata["torque_filter_hz"] = repr(rig.sensor.filter_hz)
        metadata["torque_filter_order"] = repr(rig.sensor.filter_order)
    if rig.devices.drive == "sim" and rig.simulation is not None:
        metadata["simulation_seed"] = str(rig.simulation.seed)
    return metadata


def _text(value: float | str) -> str:
    # A file's name may be no text; nothing of it may keep the session from being written.
    return (
        value.encode(errors="backslashreplace").decode() if isinstance(value, str) else repr(value)
    )
