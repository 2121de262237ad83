"""The client without I/O: bytes and times in, bytes and events out. A C# or TypeScript client ports exactly this room.

`connection` (hello, resume, heartbeats, snapshots, requests; with `inbox` and `outbox`), `clock` (session time),
`state_stream` (frames to poses), `interpolation` (poses to show), `scene_follower` (bodies to poses over scene
changes), `asset_loader` (which chunk to request next), `arrival_meter` (what the client reports of itself). The
session mirror, which the server uses too, is `iris_session.protocol.session_mirror`.

Not here: sockets, clocks, threads, files. NumPy only where poses are decoded. `docs/protocol/conversations.json` has
scripted conversations of this room, for tests of other implementations.
"""
