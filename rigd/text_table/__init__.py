"""Tables in text files of other programs: their layout, their numbers, and what does not fit.

`read_table` finds separator, decimal sign, titles, row of units and first line of numbers, reads
some columns, and refuses every line that is not of that table, with its number. `decode_text` reads
a text that may begin with a byte order mark. The public module `titles` has what titles of columns
state of units and times. The ground floor: it knows nothing of rigs.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
