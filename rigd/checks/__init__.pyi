from ._check import check_rig as check_rig
from ._check import check_without_devices as check_without_devices
from ._gate import ACCEPTABLE as ACCEPTABLE
from ._gate import FailedCheck as FailedCheck
from ._gate import PaperCheckResult as PaperCheckResult
from ._gate import check_on_paper as check_on_paper
