from . import address as address
from . import client as client
from ._main import run_daemon as run_daemon
from ._page import page_address as page_address
from ._stop import StopReport as StopReport
from ._stop import stop_all as stop_all
