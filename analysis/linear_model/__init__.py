"""Linear models of an identified antenna, for the design of controllers and for simulations.

`identified_in_session` and `identified_in_document` return the result of an analysis;
`linear_model` converts it to a state space with its error, its uncertainty and samples of the
posterior.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
