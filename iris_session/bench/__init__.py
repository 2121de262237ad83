"""Benchmarks behind `iris-session bench`: separate processes, percentiles, one JSON object (`contract`).

`state` and `input` run the authority here and its clients (`clients`) in other processes, at most four in each; beside
them, as their reference, `bare` measures the machine without us.
"""
