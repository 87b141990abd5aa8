"""Linear models of an identified antenna, for the design of controllers and for simulations.

`identify_session` and `read_identified_model` return the result of an analysis;
`linear_model` converts it to a state space with its error, its uncertainty and samples of the
posterior.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
