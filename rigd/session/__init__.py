"""Session files (MCAP): format, writer, reader, recovery.

Offers the writer (`SessionWriter`), readers (`read_session`, `read_controls`, `read_timings`,
`read_touches`; `read_summary` without the samples), a text summary (`describe`), validity of the
numbers of a record (`Validity`) and recovery (`recover`). Its public modules are `layout` (bytes of
the messages, flags of a sample), `limits` (most data that is read), `user_metadata` (metadata of
users), `touches` (estimated touches in metadata and words), `quick_look` (files of quick looks) and
`online_fit` (stream of a running session to the online fit). It depends on no devices and no loop.

Names are imported on first use, so that the control process, which packs messages only, does not
pay for the rest.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
