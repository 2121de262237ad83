"""Generators for other languages and documents, from the Python definitions of the protocol.

`python -m tools.codegen all [--check]` in a checkout, or one target, like `csharp`. `schema` reads the definitions;
`csharp`, `typescript`, `typescript_schema`, `tables` and the modules of golden vectors (`golden`, `conversations`,
`*_golden`, with `examples` and `vectors`) write from it. What does not depend on the definitions is in the templates
beside them: `Messages.cs`, `schema.ts`. `rigid_reference` is the payload of the state stream in plain Python, the
reference for `streams.rigid` and for ports; `conversions` converts poses for engines.
"""
