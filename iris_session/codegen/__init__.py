"""Generators for other languages and documents, from the Python definitions of the protocol.

`python -m iris_session.codegen csharp|typescript|golden|scene|docs|all [--check]` in a checkout. `schema`
reads the definitions; `csharp` (with `csharp_reader` and `csharp_writer`), `typescript`, `golden` and `scene_golden`
(with `examples`) and `tables` write from it. `rigid_reference` is the payload of the state stream in plain Python, the
reference for `streams.rigid` and for ports; `conversions` converts poses for engines.
"""
