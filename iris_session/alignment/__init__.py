"""Alignment of headsets to anchors: live, as a service of the front, and offline, from a recording.

Live: `service` (all connections of a session), `estimator` (proposals of one connection), `monitor` (drift and jumps
of one connection), `cross_check` (pairs of headsets). Offline: `smoother` (the alignment at any moment of a recording)
and `resolve` (what is compared with it). The mathematics is in `anchors`, the decision to use a proposal in
`authority`. No sockets and no clocks: time is passed in.
"""
