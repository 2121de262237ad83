"""Control: commands to `ctrl`. Clutch, interpolation, inverse kinematics, limits, hold.

No sockets, no clock, no threads, and no decision who may command: that is the authority's.
"""

from iris_session.control.config import ControlConfig, ControlError
from iris_session.control.controller import Controller

__all__ = ["Controller", "ControlConfig", "ControlError"]
