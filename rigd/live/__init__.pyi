from .ring_reader import LiveEnd as LiveEnd
from .ring_reader import LiveJob as LiveJob
from .ring_reader import LiveSession as LiveSession
from .server import LiveAddress as LiveAddress
from .server import RerunError as RerunError
from .viewer import PageOfFile as PageOfFile
from .viewer import Viewer as Viewer
from .viewer import Window as Window
