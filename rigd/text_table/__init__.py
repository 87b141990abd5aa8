"""Tables in text files of other programs: detection of the layout, reading of columns, errors.

`read_table` detects separator, decimal sign, titles, row of units and first line of numbers, reads
some columns, and reports every invalid line with its number. `decode_text` decodes a text with or
without a byte order mark. The public module `titles` recognises units and times in the titles of
columns. The package depends on no other package.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
