"""Assets: byte strings by their SHA-256. The stores on disk, and the server that sends them in chunks.

`store` keeps the assets that a session serves, `cache` those that a client fetched. Not here: what the bytes mean
(`scene`).
"""
