from . import measure as measure
from ._program import HIGHEST_HZ as HIGHEST_HZ
from ._program import Bench as Bench
from ._program import Results as Results
from ._program import cores_without_loop as cores_without_loop
from ._program import loop_core as loop_core
from ._report import as_json as as_json
from ._report import report_lines as report_lines
