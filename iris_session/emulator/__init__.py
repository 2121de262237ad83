"""Emulated headsets and operators for demos, tests and benchmarks. They see only the state stream.

`headset` (tracking frame, noise, sheet detections), `gaze` (head motion), `behaviours` (scripted hands), `operator`
(one client with headset and behaviour), `runner` (many in one loop; `python -m iris_session.emulator`), `specs` (their
configuration and reports). Not here: delays of a link (`netsim`), the demos themselves (`demo`).
"""
