from . import measure as measure
from ._program import HIGHEST_LOOP_RATE_HZ as HIGHEST_LOOP_RATE_HZ
from ._program import Bench as Bench
from ._program import BenchResults as BenchResults
from ._program import cores_without_loop as cores_without_loop
from ._program import loop_core as loop_core
from ._report import as_json as as_json
from ._report import report_lines as report_lines
