"""Session files (MCAP): format, writer, reader, recovery.

Offers the messages' byte layout (`SAMPLE_TYPES`, `pack_sample_into`, `Status`), the writer
(`SessionWriter`), readers (`read_session`, `read_controls`, `read_timings`, `read_touches`;
`read_summary` without the samples), a description for people (`describe`), the rules of what users
add to the metadata (`metadata_keys`), touches in words (`touch_line`), validity of the numbers of a
record (`Validity`), recovery (`recover`), and the stream of a running session to the online fit
(`write_start`). It knows of no devices and no
loop.
Names are imported on first use, so that the control process, which packs messages only, does not
pay for the rest.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
