from .devices import SimulatedRig as SimulatedRig
from .plant import SimulatedPlant as SimulatedPlant
