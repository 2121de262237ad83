"""The wire and the internal contracts of the session. Pure: no sockets, clocks, threads, MuJoCo or randomness.

Wire: `common` (value types), `names` (open enumerations), `client_messages`, `server_messages`, `status`, `media`,
`assets`, `scene`, `discovery`, `pairing`; `codec` and `limits` are the trust boundary, `errors` its exceptions.
Internal contracts: `entries` (input of the authority, the journal), `specs` (robots, objects), `steps` (authority to
control to physics). `session_mirror` rebuilds the shared state from a snapshot and events. Sockets live in `front` and
`client`.
"""
