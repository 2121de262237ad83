"""Benchmarks: one module per `iris-session bench NAME`, each with a `run_...` function that returns a `BenchReport`.

`report` defines the report and its bars, `harness` runs a session with client processes, `clients` are those
processes, `baseline` measures the machine itself. The command line is in `iris_session.cli.bench`.
"""
