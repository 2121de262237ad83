"""A session of several participants in one process and in simulated time.

`Rig` runs the real `Session` with its stepper, authority, control and MuJoCo, the real `Front`, and real `Client`s and
emulated headsets. Only what lies between them is replaced: sockets by queues with the delays of `netsim`, clocks by one
that the rig moves, helper threads by events. A run depends on the scenario and its seed alone, and never on the speed
of the machine.

- `simulation`: the clock, and what takes the place of `time`, `threading` and `secrets` in the package
- `network`: in-memory sockets of the front and of clients, and links with delays, stalls and cuts
- `front`: the front as a part of the rig, which can be killed and is replaced
- `journal`: the recorder's place; it keeps the journal and re-simulates it
- `session`: `Rig`, which puts them together, and `Hand`
"""
