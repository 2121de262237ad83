"""The client without I/O: bytes and times in, bytes and events out. A C# or TypeScript client ports exactly this room.

- `connection`: hello, resume, heartbeats, snapshots, requests; with `outbox` and `status`
- `clock`: session time
- `state_stream`, `interpolation`: frames to poses, and poses to show
- `scene_follower`: bodies to poses over scene changes
- `samples`: samples with fencing numbers
- `asset_loader`: which chunk to request next
- `arrival_meter`: what the client reports of itself

The session mirror, which the server uses too, is `iris_session.protocol.session_mirror`. Not here: sockets, clocks,
threads, files. NumPy only where poses are decoded. `docs/protocol/conversations.json` has scripted conversations of
this room, for tests of other implementations.
"""
