from . import address as address
from . import messages as messages
from ._viewer import FileWindow as FileWindow
from ._viewer import PageOfFile as PageOfFile
from ._viewer import Viewer as Viewer
