"""Demos: scenes of the package, the cast of each demo, its goals, and a run of it as a complete session.

`scenes` (MJCF files and generators), `named_scenes` (scenes by name), `demos` (scene and cast of each demo), `goals`
(success of a task with a deformable), `run` (one demo from start to verdict), `impairment` (impaired links in front of
a session).
"""
