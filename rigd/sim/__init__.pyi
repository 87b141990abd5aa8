from ._devices import SimulatedRig as SimulatedRig
from ._plant import SimulatedPlant as SimulatedPlant
