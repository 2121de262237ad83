"""Command -> `ctrl`: clutch, interpolation, inverse kinematics, limits, hold. No sockets, no clock, no threads."""

from iris_session.control.config import ControlConfig
from iris_session.control.controller import Controller
from iris_session.control.errors import ControlError

__all__ = ["Controller", "ControlConfig", "ControlError"]
