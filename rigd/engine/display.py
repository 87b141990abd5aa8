"""What the control process shows on the board: readings, and how the devices' lines are doing."""

from math import isfinite

from rigd.devices.contracts import Devices, LineHealth
from rigd.engine.board import UNKNOWN, Board, Word
from rigd.engine.cycle import Cycle


class Display:
    """Writes the board's words of the control process, some times a second.

    Parameters
    ----------
    board
        Where.
    devices
        Of whose lines it tells.

    Attributes
    ----------
    doubts
        About the age of the readings, as of the last call of `show`, for the operator.
    """

    def __init__(self, board: Board, devices: Devices) -> None:
        self._board = board
        self._devices = devices
        self.doubts: list[str] = []
        self._before: tuple[int, tuple[int, ...]] | None = None

    def show(self, cycle: Cycle, now_ns: int) -> None:
        """Show that the control process is at work, and what it reads.

        Parameters
        ----------
        cycle
            With the last readings.
        now_ns
            On the engine's clock: a line's load is taken from one call to the next.
        """
        board = self._board
        board.beat(Word.CONTROL_BEAT)
        for word, value in (
            (Word.ANGLE_NRAD, cycle.angle_rad),
            (Word.COUPLING_TORQUE_NNM, cycle.coupling_torque_nm),
            (Word.TORQUE_COMMAND_NNM, cycle.torque_command_nm),
        ):
            if isfinite(value):
                board[word] = round(value * 1e9)
        drive, sensor = self._devices.drive.health(), self._devices.sensor.health()
        self.doubts = [line.doubt for line in (drive, sensor) if line.doubt]
        known = [line.errors for line in (drive, sensor) if line.errors is not None]
        board[Word.BUS_ERRORS] = sum(known) if known else UNKNOWN
        board[Word.SENSOR_STATUS] = UNKNOWN if sensor.status is None else sensor.status
        self._show_load((drive, sensor), now_ns)

    def _show_load(self, lines: tuple[LineHealth, ...], now_ns: int) -> None:
        """Show the load of the busiest line since the last call."""
        bits = tuple(line.bits or 0 for line in lines)
        if self._before is None:
            self._board[Word.BUS_LOAD_PPM] = UNKNOWN
        else:
            then_ns, before = self._before
            if now_ns <= then_ns:
                return  # virtual time stands still
            per_ppm = 1e-15 * (now_ns - then_ns)  # 1e-9 s, 1e-6
            loads = [
                (now - then) / (line.bit_rate_bit_s * per_ppm)
                for line, now, then in zip(lines, bits, before, strict=True)
                if line.bit_rate_bit_s
            ]
            self._board[Word.BUS_LOAD_PPM] = round(max(loads)) if loads else UNKNOWN
        self._before = now_ns, bits
