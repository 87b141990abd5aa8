from ._check import check_rig as check_rig
from ._check import check_without_devices as check_without_devices
from ._offline_checks import ACCEPTABLE_ROW_NAMES as ACCEPTABLE_ROW_NAMES
from ._offline_checks import FailedCheck as FailedCheck
from ._offline_checks import OfflineCheckResult as OfflineCheckResult
from ._offline_checks import run_offline_checks as run_offline_checks
