"""A rig's profile: one TOML file that says everything about the rig, with units and sources.

Offers the loader (`load_profile`), the validated dataclass (`Profile`), writing a profile with
other values (`write_new`) and a draft from a drive's EDS file (`Draft`). The loader is imported on
first use: the control process is handed a profile that was validated, and does not pay for the
validation. Devices are described here, never opened.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
