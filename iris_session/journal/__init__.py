"""Journal of a session: its rows and keyframes, the feed of the recorder, and what a verification checks.

Here are the records of a session (`rows.py`), the messages between authority and recorder (`messages.py`), the feed
that sends them (`feed.py`), the check of rows and keyframes by taking the steps again (`verification.py`), and the
environment that this must share with the recording. Nothing here knows in which file the records lie, or how they look:
that is in `rrd`, `viewer` and `recording`.
"""
