from ._budget import MAX_BUS_LOAD as MAX_BUS_LOAD
from ._budget import BusLoad as BusLoad
from ._budget import bus_load as bus_load
from ._budget import check_identifiers as check_identifiers
from ._exchange import CanExchange as CanExchange
from ._exchange import CanLink as CanLink
from ._exchange import ReplyPairing as ReplyPairing
