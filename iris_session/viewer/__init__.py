"""Drawing of a session for Rerun's viewer: scene, participants, log, lanes, plots, and the arrangement of views.

`SessionDrawing` draws from the records of the journal; nothing here is needed to verify a recording, and nothing reads
one. Copies of recordings for the viewer are made by `recording/viewer_export.py`, without drawing anything anew.
"""
