"""ZeroMQ sockets for clients, in the `front` process, and the authority's side of its link.

`process.FrontProcess` starts and restarts the front, `link.FrontLink` exchanges entries and decisions with it. In the
front: `front` (the loop), `intake` and `coalescer` (client -> authority), `admission` and `resume_tokens` (identity),
`clients` (connections and sending), `doors` and `memory` (who is too many, too much, or silent), `announce`, `beacon`,
`introduction`, `interfaces` (being found), `anchoring` (alignment), `state_publisher`, `zap`, `sockets`.
"""

from iris_session.transport.config import FrontConfig, FrontError, FrontLimits, Ports, SceneInfo
from iris_session.transport.interfaces import addresses_of
from iris_session.transport.link import FrontLink
from iris_session.transport.process import FrontProcess

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
