"""Errors of the rig: the base classes of all errors that are reported to an operator.

::

    RigdError
     +-- UserError             the request must be changed: exit code 2
     |    +-- ProfileError          a key of the profile is missing, or its value is out of range
     |    +-- UnknownValueError     motor.peak_torque_nm has source = "unknown" in the profile
     |    +-- UnknownRowError       --accept names no row of rigd check
     |    +-- UnknownDeviceError    [devices] names a driver that does not exist
     |    +-- ExcitationError       --amplitude 0, or a CSV file with semicolons
     |    +-- IdentifiedBeamError   --model of a file that holds no beam
     |    +-- ObstacleError         --obstacle x=0.62,angle=…: a key is missing or out of range
     |    +-- ControlDesignError    the closed loop would be unstable
     |    +-- RealisationError      the beam's damping has no stable state space
     |    +-- RefusedError          the predicted angle exceeds limits.angle_rad
     |    |    +-- NoRoomError          the disk is too full for the session
     |    +-- TipSlopeError         --tip-slope 0
     |    +-- MetadataError         --meta temperature_c=warm: the name's unit asks for a number
     |    +-- LibraryError          rigd list of a folder that does not exist
     |    +-- UnknownGroupError     --group names no group of this computer
     |    +-- PluginError           an installed package cannot be used
     |    +-- WrongUseError         rigd inject with a fault that does not exist
     +-- FailureError          the same request may succeed later: exit code 1
     |    +-- DeviceError           the drive does not answer, or reports a fault
     |    +-- ControllerError       the code of a package's controller failed in a tick
     |    +-- CheckFailedError      rigd check fails without a device: the worst travel is too long
     |    +-- ProbeFailedError      the probing move contradicts a scale of the profile
     |    +-- ChildError            the control process was killed
     |    +-- RigError              the rig is not connected, or its zero is lost
     |    +-- SessionFailedError    the recorder died; part of the record is stored
     |    +-- SeriesFailedError     one of the two, after some sessions of a series
     |    +-- RigBusyError          another program runs the rig
     |    +-- UnsafeFolderError     others can write to the runtime folder
     |    +-- AddressError          no daemon is running, or its socket cannot be made
     |    +-- DaemonUnreachableError  the daemon was killed during a request
     |    +-- SessionError          a session file is damaged, or the disk is full
     |    +-- MissingExtraError     --live without the packages of rigd[live]
     |    +-- RrdFileError          a recording for Rerun exists already
     |    +-- RerunError            Rerun's program cannot be run
     |    +-- EdsError, UnusableDriveError    the EDS file of a drive is invalid or insufficient
     |    +-- MotorEstimateError    the sessions do not determine the motor's data
     |    +-- LoopError, CyclictestError      rigd bench could not measure
     +-- CommandError, RefusedByDaemonError   of either kind, as reported by the daemon

`rigd.cli.options.exit_on_errors` handles them for all commands. Any other exception is a mistake in
the program and ends with a traceback. The control process switches the torque off after any
exception.
"""


class RigdError(Exception):
    """Base class of all errors whose message is for the operator."""

    wrong_use = False
    """Whether the request must be changed; otherwise the same request may succeed later."""

    def full_message(self) -> str:
        """Return the message for the operator; overrides may take seconds to check more facts."""
        return str(self)


class UserError(RigdError):
    """Base class of errors after which the operator must change the request: exit code 2."""

    wrong_use = True


class FailureError(RigdError):
    """Base class of errors after which the same request may succeed later: exit code 1."""
