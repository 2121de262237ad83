"""The border between authority and front: start configuration, messages, and the authority's side of it.

`FrontProcess` starts and restarts the front, `FrontLink` exchanges entries and decisions with it. Not here: what the
front does with them (`front`).
"""

from iris_session.link.config import FrontConfig, FrontError, FrontLimits, Ports, SceneInfo
from iris_session.link.front_link import FrontLink
from iris_session.link.front_process import FrontProcess
from iris_session.link.interfaces import addresses_of

__all__ = [
    "FrontConfig",
    "FrontError",
    "FrontLimits",
    "FrontLink",
    "FrontProcess",
    "Ports",
    "SceneInfo",
    "addresses_of",
]
