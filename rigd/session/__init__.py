"""Session files (MCAP): format, writer, reader and recovery.

The package offers the writer (`SessionWriter`), readers (`read_session`, `read_controls`,
`read_timings`, `read_touches`, and `read_summary` without the samples), a summary for the operator
(`describe`), the validity of numbers estimated from a record (`Validity`), and recovery of damaged
files (`recover`). Its public modules are `layout` (byte layout of the messages, flags of a sample),
`limits` (maximum amounts of data that are read), `user_metadata` (metadata that users add),
`touches` (estimated touches in metadata and text), `quick_look` (files of quick looks) and
`online_fit` (stream of a running session to the online fit). It does not depend on devices or on
the control loop.

Names are imported on first use, so that the control process, which only encodes messages, does not
load the other modules.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
