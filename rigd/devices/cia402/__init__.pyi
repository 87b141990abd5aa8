from ._assignments import parse_assignment as parse_assignment
from ._drive import Cia402Drive as Cia402Drive
from ._setup import DriveCapabilities as DriveCapabilities
from ._suitability import Finding as Finding
from ._suitability import Grade as Grade
from ._suitability import judge as judge
