"""Recorded sessions taken again step by step, for what a recording does not store: joints, forces, commands.

`simulation` takes the steps of a journal again with the core that `verify` uses; `plant_reader` reads numbers of robots
and objects from its world; `recorded_session` is the public `Recording`; `export` writes tables. Not here: reading the
file (`recording`), the core itself (`session`).
"""
