"""Benchmarks: one module per `iris-session bench NAME`, each with a `run_...` function that returns a `BenchReport`.

`report` defines the report and its bars, `harness` runs a session with client processes, `clients` are those
processes, `baseline` measures the machine itself. The command line, with the meaning and the defaults of the options of
every `run_...`, is in `iris_session.cli.bench`; each also calls `progress` with short texts.
"""
