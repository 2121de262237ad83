"""The front process: every socket for clients, identity, limits, and what reaches the authority.

`python -m iris_session.front.main` runs it, `loop` wires it, `context` holds what its parts share. In: `intake`
decodes and limits, `coalescer` queues entries for the authority, `uplink` sends them. Out: `downlink`,
`state_publisher`, `media`, `asset_server`. `connection_guard` limits peers, over the `TcpGuard` of `link`. Not here:
messages of the link and the parent's side of the process (`link`), keys (`security`), the alignment estimate
(`alignment`).
"""
