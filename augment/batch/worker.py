"""What a worker process runs: take the scene, render the chunks it is sent, report each image."""

from __future__ import annotations

import os
import threading
from dataclasses import dataclass
from multiprocessing.connection import Connection
from queue import SimpleQueue

from augment.batch.backends import renders_on_gpu
from augment.batch.lock import InheritedLock
from augment.batch.processes import quick_turns, sender
from augment.batch.runner import Chunk, FrameRunner, Renderer, Setup, describe
from augment.batch.shared_scene import SharedScene
from augment.batch.writer import WritePump
from augment.errors import GpuLost, OutputError


@dataclass(frozen=True)
class Ready:
    """The scene is there; rendering can begin."""


@dataclass(frozen=True)
class Failure:
    """The worker cannot go on. is_output: what it could not do is write."""

    is_output: bool
    text: str


@dataclass(frozen=True)
class Spent:
    """The worker has ended as it was told to. seconds: by the kinds of `times`."""

    seconds: dict[str, float]


def worker_main(
    connection: Connection,
    setup: Setup,
    shared: SharedScene,
    renderer: Renderer | None,
    threads: int,
    lock: InheritedLock,
) -> None:
    """Serve chunks until told to stop. `lock` is only held: the folder stays ours until we end."""
    import cv2
    import torch

    torch.set_num_threads(threads)
    cv2.setNumThreads(1)
    inbox: SimpleQueue[Chunk | None] = SimpleQueue()
    stopped = threading.Event()
    threading.Thread(target=_listen, args=(connection, inbox, stopped), daemon=True).start()
    send = sender(connection)
    try:
        scene = shared.open()
        for bed in setup.beds:
            bed.take_over(scene)
    except Exception as error:
        send(Failure(False, describe(error, "taking over the scene in a worker process")))
        return
    send(Ready())
    if renders_on_gpu(setup.backend):
        pump = WritePump.beside(setup.backend, threads)
    else:  # one thread and little waiting: the memory of a view counts once per worker
        pump = WritePump(threads=1, waiting=2)
    runner = FrameRunner(scene, setup, renderer, send, pump)
    try:
        with quick_turns(renders_on_gpu(setup.backend)):
            try:
                while True:
                    if inbox.empty():  # the next chunk may depend on what becomes of the last view
                        runner.land()
                    if (chunk := inbox.get()) is None:
                        break
                    runner.run(chunk, stopped.is_set)
            finally:
                seconds = runner.close()
        send(Spent(seconds))
    except OutputError as error:
        send(Failure(True, str(error)))
    except GpuLost:  # as any death of a worker: another one tries what this has in hand
        raise
    except Exception as error:
        send(Failure(False, describe(error, "in a worker process")))


def _listen(connection: Connection, inbox: SimpleQueue, stopped: threading.Event) -> None:
    """Receive beside the rendering, so that a stop or the parent's end is noticed at once."""
    while True:
        try:
            chunk = connection.recv()
        except (EOFError, OSError):
            os._exit(1)  # the parent has gone: nobody is left to report to
        if chunk is None:
            stopped.set()
        inbox.put(chunk)
