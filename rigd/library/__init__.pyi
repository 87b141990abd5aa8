from . import trend as trend
from ._row import REPORT_PAGE as REPORT_PAGE
from ._row import SessionRow as SessionRow
from ._sessions import list_sessions as list_sessions
