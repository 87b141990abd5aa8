"""Profile of a rig: one TOML file with all parameters of the rig, their units and sources.

The package offers the loader (`load_profile`), the validated dataclass (`Profile`), writing a
profile with other values (`write_new`) and a draft from a drive's EDS file (`Draft`). The loader is
imported on first use, because the control process receives a validated profile. The package
describes devices and never opens them.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
