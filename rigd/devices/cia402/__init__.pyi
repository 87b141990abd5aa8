from ._assignments import parse_assignment as parse_assignment
from ._drive import Cia402Drive as Cia402Drive
from ._setup import DriveCapabilities as DriveCapabilities
from ._suitability import Grade as Grade
from ._suitability import SuitabilityFinding as SuitabilityFinding
from ._suitability import check_suitability as check_suitability
