"""Finding out in a minute why a headset shows nothing: one small check after the other, each with what to do.

`findings` holds what a check says, `reach` the way to a session, `door` keys and joining, `condition` what the session
reports of itself, `machine` the server's machine. `examination` puts them in order.
"""
