from ._devices import SimulatedRig as SimulatedRig
from ._devices import Stuck as Stuck
from ._plant import SimulatedPlant as SimulatedPlant
