"""The media channel of the front: deformables and other large streams.

`proxy` is the thread with the sockets, `scheduler` (pure) says what is due, `budget` (pure) which level each client
gets, `recorder` sends
clouds and pictures to the recorder, and `service` is the side of the front's loop.
"""
