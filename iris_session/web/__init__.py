"""Gateway for browsers and apps without ZeroMQ: HTTPS, WebSockets and the page, in front of a session.

Modules, from pure to processes: `wire` (bytes of web messages), `hub` (browsers, tickets, limits), `certificate`,
`page` (files of the page, HTTP headers), `sockets`, `assets`, `listener`, `server`, `gateway` (the process), `process`
(the session's side of it). Not here: identity and roles of people behind a gateway (`front.admission`).
"""
