"""Exact model of the slewing beam with fractional damping (Section 4 of the paper).

Offers the transfer function from motor angle to coupling torque (`transfer`, `TransferGrid`), the
modes and their poles (`modes`, `poles`), the deflection (`DeflectionFilter`), a force at a point of
the beam (`PointForceGrid`, `realise_force`), the plant of beam, ends and torque channel (`Plant`)
with the table of its parameters (`PARAMETERS`), the air's drag (`DragGrid`), and responses in time
from transfer functions (`CausalTransform`). Its public module
`realisation` has the state space that runs in real time, and `tip` the motion of the free end. The
package does not depend on rigs or files.
"""

import lazy_loader as lazy

__getattr__, __dir__, __all__ = lazy.attach_stub(__name__, __file__)
