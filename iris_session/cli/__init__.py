"""The command `iris-session`: one module per command; `main` parses and dispatches, `common` is shared.

Errors are one line on standard error. Exit status: 0 done, 1 the work failed (not verified, no handover, bar missed),
2 unusable input, 130 interrupted. What commands do lives in the other packages; here are options and output.
"""
