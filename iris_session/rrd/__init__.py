"""Rerun files as containers: names in them, bytes and messages, columns, the index, salvage, and assets in pieces.

Here are the stream that a recorder appends (`stream.py`), the list of messages and the checksums over them (`file.py`),
what is readable of a damaged file (`salvage.py`), the index (`index.py`), the one place that runs `rerun rrd`
(`rerun_tool.py`), the decoders of our columns (`batches.py`) and assets (`assets.py`). What a recording of several
files is, and what it looks like in the viewer, is in `recording` and `viewer`.
"""
