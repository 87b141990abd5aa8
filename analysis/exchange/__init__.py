"""Import of records of other programs, export of records, frequency responses and models.

`read_source` reads channels of a third-party file unchanged; `import_record` makes a session file
of a measurement by an `ImportPlan`, and `write_session` one of arrays; `export_record`,
`export_frf` and `export_model` write files that other programs read. Each format is a module behind
one table (`_source`), and knows names and numbers only. Responses are estimated by
`analysis.paper`, models by `analysis.linear_model`.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
