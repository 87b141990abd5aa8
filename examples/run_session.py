"""Run two short sessions on the simulated rig from Python, not in real time.

Usage: python run_session.py [FOLDER]

The files go to FOLDER (default: sessions). This is `rigd run chirp --fast --repeat 2`: the plan is
checked against the profile's limits, and Ctrl-C stops safely.
"""

import sys
from pathlib import Path

from rigd.errors import RigdError
from rigd.excitation import Excitation
from rigd.profile import Profile
from rigd.runner import ProcessGroup, run_in_foreground
from rigd.runner.planning import excitation_for
from rigd.runtime import StopRequest

CHIRP = {
    "amplitude_rad": 0.025,
    "start_hz": 0.05,
    "stop_hz": 50.0,
    "duration_s": 20.0,
    "rest_s": 0.5,
    "ring_down_s": 1.0,
    "taper_s": 0.0,
}


def chirp(profile: Profile) -> Excitation:
    """Return the excitation, planned for the rate and the limits of the profile."""
    return excitation_for(profile, "chirp", CHIRP)


def main() -> None:
    """Run the sessions and print how they ended."""
    folder = Path(sys.argv[1] if len(sys.argv) > 1 else "sessions")
    stop = StopRequest()
    stop.catch_signals()  # Ctrl-C, a closed terminal and SIGTERM stop the session, close its file
    try:
        results = run_in_foreground(
            chirp,
            ProcessGroup(with_live_view=False),
            stop,
            profile_name="sim",
            folder=folder,
            session_count=2,
            seed=1,
            notes={"specimen": "antenna 3", "operator": "an example"},
            uses_virtual_clock=True,  # as --fast
            with_live_view=False,
            allows_saturation=False,
            quiet_stdout=True,
        )
    except RigdError as error:
        sys.exit(str(error))
    for result in results:
        print(f"{result.outcome}: {result.recorded} of {result.scheduled} samples, {result.path}")


if __name__ == "__main__":
    main()
