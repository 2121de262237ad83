"""The front process: every socket for clients, identity, limits, and what reaches the authority.

`python -m iris_session.front.main` runs it, `loop` wires it. In: `intake` decodes and limits, `coalescer` keeps what
waits for the authority, `uplink` sends it. Out: `downlink`, `state_publisher`, `media`. Not here: the link's messages
and the parent's side of the process (`link`), keys (`security`), the alignment estimate (`alignment`).
"""
