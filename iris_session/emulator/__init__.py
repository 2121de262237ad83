"""Emulated headsets and the people who wear them: for demos, tests and benchmarks. They see only the state stream.

`headset` (tracking frame, noise, sheet detections), `link` (latency, jitter, stalls), `behaviours` (what people do),
`person` (one client, headset and behaviour), `runner` (many in one loop; `python -m iris_session.emulator`).
"""
