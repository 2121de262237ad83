"""The session authority. Pure: no sockets, clocks, threads, MuJoCo or randomness.

Roster, roles, assignment, leases, arbitration (samples to one command per robot), grasps, episodes, e-stop, alignment
gate, handovers, feedback. It decides; `control` moves, `physics` simulates, the front talks to the network.
"""

from iris_session.authority.authority import Authority
from iris_session.authority.config import AuthorityConfig, SpeedLimit
from iris_session.authority.state import is_same_snapshot

__all__ = ["Authority", "AuthorityConfig", "SpeedLimit", "is_same_snapshot"]
