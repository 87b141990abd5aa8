"""Import of records of other programs, export of records, frequency responses and models.

`read_source` reads channels of a third-party file unchanged. `import_record` converts a measurement
to a session file by an `ImportPlan`, `write_session` does so for arrays. `export_record`,
`export_frf` and `export_model` write files that other programs read. Each file format has a module
of its own, which `_source` selects by the file's suffix. `analysis.paper` estimates the exported
responses, `analysis.linear_model` the exported models.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
