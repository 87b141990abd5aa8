from . import titles as titles
from ._encoding import decode_text as decode_text
from ._errors import MissingColumnError as MissingColumnError
from ._errors import TableError as TableError
from ._reader import TextTable as TextTable
from ._reader import read_table as read_table
