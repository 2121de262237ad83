"""`iris-session doctor`: find out why a headset shows nothing. Small checks in order, each with a cause and advice.

`findings` holds the result of a check. `network_checks` check the route to a session, `join_checks` keys and
joining, `session_checks`, `headset_checks` and `stream_checks` at the `StatusReport` of the session, `host_checks` at
the machine that serves. `runner` runs them in order. Printing is in `iris_session.cli.doctor`; nothing here changes a
session.
"""
