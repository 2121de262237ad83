"""The wire and the internal contracts of the session. Pure: no sockets, clocks, threads, MuJoCo or randomness.

`names` (open enumerations), `common` (value types), `client_messages`, `server_messages` (the wire), `entries` (what
reaches the authority and the journal), `specs` (robots, objects), `steps` (authority -> control -> physics).
"""
