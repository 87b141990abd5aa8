from ._detector import DetectorSettings as DetectorSettings
from ._detector import TouchDetector as TouchDetector
from ._innovations import FreeBeam as FreeBeam
from ._innovations import InnovationFilter as InnovationFilter
from ._innovations import Noise as Noise
from ._innovations import free_beam as free_beam
