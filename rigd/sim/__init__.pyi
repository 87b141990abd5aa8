from ._devices import SimulatedRig as SimulatedRig
from ._devices import StuckReadings as StuckReadings
from ._plant import SimulatedPlant as SimulatedPlant
from ._session_scatter import session_parameters as session_parameters
