"""Alignment of headsets to anchors: live, as a service of the front, and offline, from a recording. No sockets.

Live: `service`, `estimation`, `drift`, `cross_check`, `touch`. Offline: `smoother`, `resolve`. The mathematics is in
`anchors`.
"""
