"""Data sets for training, made of recordings after the session: which episodes, their frames, pictures, file formats.

Sessions are re-simulated as by `replay`, and compared bit for bit on the way. Rules and units: docs/datasets.md.
"""
