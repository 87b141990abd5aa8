"""Commands ``rigd simulate`` and ``rigd inject``: simulated devices on the bus, and faults."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import typer

from rigd.cli.options import Obstacles, ProfileName, Seed, profile_named


def simulate(
    profile: ProfileName,
    lock_step: Annotated[
        bool,
        typer.Option(
            "--lock-step", help="Advance one period per SYNC, not in real time (run --fast)."
        ),
    ] = False,
    log: Annotated[
        Path | None,
        typer.Option(
            "--log", metavar="FILE", help="Write every event as a line of JSON, to a new file."
        ),
    ] = None,
    fault: Annotated[
        list[str] | None,
        typer.Option("--fault", metavar="SPEC", help="Inject a fault; see rigd inject --help."),
    ] = None,
    eds: Annotated[
        Path | None,
        typer.Option(
            "--eds", metavar="FILE", help="Simulate the drive that this EDS or DCF file describes."
        ),
    ] = None,
    obstacle: Obstacles = None,
    seed: Seed = None,
    quiet: Annotated[bool, typer.Option("--quiet", help="Print nothing on the terminal.")] = False,
) -> None:
    """Simulate the devices of a profile on the wire; Ctrl-C ends it.

    Sessions of the same profile find it automatically. Its drive and its sensor use the protocols
    of the real ones, on a socket or a virtual CAN bus and on a pseudo-terminal. With --eds the
    drive has the objects of the manufacturer's file and no others.

    Example: rigd simulate --profile antenna_can --fault drop,from=drive,frames=3@10
    """
    from rigd.devices import simulator as simulator_of

    simulator = simulator_of()
    simulator_options = simulator.SimulatorOptions(
        lock_step=lock_step,
        log=log,
        faults=tuple(simulator.parse_fault(fault_spec) for fault_spec in fault or ()),
        quiet=quiet,
        eds=eds,
    )
    rig = profile_named(profile).rig
    if obstacle:
        from rigd.devices.obstacles import with_obstacles

        rig = with_obstacles(rig, obstacle)
    if seed is not None and rig.simulation is not None:
        rig = replace(rig, simulation=replace(rig.simulation, seed=seed))
    raise typer.Exit(simulator.run_simulator(rig, simulator_options))


def inject(
    profile: ProfileName,
    fault: Annotated[
        list[str] | None, typer.Argument(metavar="[SPEC]...", help="Faults, as above.")
    ] = None,
) -> None:
    """Inject faults into a running simulated rig.

    Without a fault, the status of the rig is shown. A fault happens at once, or with @SECONDS that
    long after the drive was first enabled. It lasts for the time of for=, else until `end`. Times
    are those of the simulated rig.

    \b
    drop,from=drive|sensor|host[,id=0x181][,frames=3]  the next frames are lost
    drop,from=sensor,bytes=5                  that many bytes on a sensor's serial line
    delay,from=...,ms=2[,id=...][,frames=3]   frames are delayed
    corrupt,from=...[,byte=0][,id=...][,frames=3]  one byte of each frame is inverted
    reorder,from=...[,id=...][,frames=3]      frames are swapped
    freeze,device=drive|sensor[,for=0.5]      the device stops communicating
    emcy,code=0x8130[,register=1]             the drive reports an emergency
    sto[,for=0.5]                             the drive's STO is activated
    busoff[,for=0.5]                          the host's CAN controller is off the bus
    saturate,gauge=0..5[,for=0.5]             a strain gauge is at the end of its range
    status,bits=0x0080[,for=0.5]              the sensor reports errors
    stuck,what=encoder|sensor|gauge[,gauge=2][,every=2][,for=0.5]
                                              it repeats readings: all, or every second one
    jump,counts=-500                          the encoder slips
    cut[,device=bus|sensor]                   the bus, or a sensor's serial line, is cut
    restart,device=drive|sensor               the device restarts by itself
    power_cycle,device=drive|sensor           the device is switched off and on
    lag,ms=3.2[,for=0.5]                      the drive's actual torque (6077) is late
    no_bit_12[,for=0.5]                       statusword bit 12 (follows command) stays 0
    no_pre_operational[,for=0.5]              the drive ignores NMT pre-operational
    no_watch[,for=0.5]                        the drive's watchdog does not act
    object,index=0x608F,sub=1[,value=450000]  the drive states another value, or lacks the object
    obstacle,x=0.6,angle=0.3[,stiffness=3000][,damping=0][,side=1][,rate=0][,for=1]
                                              an obstacle is in the beam's way (m, rad, N/m)
    knock,x=0.5,force=2,duration=0.02         the beam is knocked (m, N, s)
    end[,fault=sto]                           end faults of one kind (release the STO), or all

    Example: rigd inject --profile antenna_can sto, then rigd inject --profile antenna_can end
    """  # noqa: D301 - the mark that keeps lines apart is not raw text
    from rigd.devices import simulator as simulator_of

    simulator = simulator_of()
    rig = profile_named(profile).rig
    simulator.check_on_wire(rig)
    typer.echo("\n".join(simulator.inject(rig.name, fault or [])))
