"""`iris-session ...`: one module per command, `main` dispatches. Errors are one line on standard error.

Exit status: 0 done, 1 the work failed (not verified, no handover, bar missed), 2 unusable input, 130 interrupted.
"""
