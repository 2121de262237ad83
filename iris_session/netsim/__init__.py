"""Network impairment in user space: a proxy in front of a session with delay, loss and outages by profile.

`profiles` (link profiles and their conditions over time, pure), `proxy` (TCP and UDP), `process` (the proxy as a child
process, and its command line).
"""
