"""Helpers around the operating system for several rooms: child processes, files, priorities, back-off, logging.

Standard library only. Not here: sockets (`link`, `front`, `client`), keys and permissions of their folder (`security`).
"""
