"""Network impairment in user space: a proxy in front of a session with delay, loss and outages by profile.

`profiles` (link profiles and their conditions over time, pure), `proxy` (TCP), `datagrams` (UDP), `process` (the proxy
as
a child process, and its command line), `latency` (a delay line inside an emulated headset, without sockets).
"""
