from ._faults import WrongUseError as WrongUseError
from ._faults import parse_fault as parse_fault
from ._simulator import SimulatorOptions as SimulatorOptions
from ._simulator import check_on_wire as check_on_wire
from ._simulator import inject as inject
from ._simulator import run_simulator as run_simulator
