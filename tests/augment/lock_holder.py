"""A child process that holds its share of an output lock; light to import."""

from __future__ import annotations

from multiprocessing.connection import Connection

from augment.jobs.processes import InheritedLock


def hold(lock: InheritedLock, connection: Connection) -> None:
    assert isinstance(lock, InheritedLock)
    connection.send("holding")
    connection.recv()
