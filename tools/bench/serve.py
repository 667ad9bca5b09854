"""`climategs bench serve`: the sensor service beside a job, and a soak with several clients.

`measure` returns two tables.
1. Images a second, and processor time an image, of six cameras a step by `batch_render_rgb` and of
   the same images by a job that writes nothing else, in turns.
2. A soak: clients replay a closed loop, each step of all cameras, with the car beside the recorded
   line. Latencies of a step, and the server's memory.
"""

from __future__ import annotations

import math
import os
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import grpc
import numpy as np

from augment.jobs.render_job import RenderJob, run_job
from augment.output.layout import variant_name
from tools.bench.harness import Figures, Table, alternate_order, figures, machine_facts
from tools.cli import ServeOptions
from tools.serve.messages import MAX_MESSAGE_BYTES, Stub, enum_numbers, message_class
from tools.serve.poses import pose_matrix, pose_message
from tools.serve.server import served_recipes, start_service

# Outputs of the recipe in the comparison: a job writes nothing else, as the service sends nothing
# else.
IMAGES_ONLY = (
    "output.labels=false",
    "output.lidar=false",
    "output.depth=none",
    "output.semantic=false",
    "output.instance=false",
)
# Distance between the car and the recorded line, at most, metres.
MAX_ASIDE_M = 2.0
# Steps in which the car swings from one side of the line to the other.
SWING_STEPS = 15
# Share of a soak that is not counted: kernels, caches and buffers grow to their size.
WARM_UP_SHARE = 0.1
# Time between two looks at the server's memory, seconds.
MEMORY_PERIOD_S = 0.5
# Time that a step may take, seconds.
DEADLINE_S = 300.0


@dataclass(frozen=True)
class ServeCase:
    """The sizes that are measured."""

    scene: str = "procedural:street?seed=3&frames=8"
    """The address of the scene."""
    recipe: str = "dense-fog"
    """The recipe."""
    scale: float = 0.5
    """The size of the images over the recorded size."""
    num_frames: int = 4
    """The number of frames that are rendered in each round."""
    clients: int = 2
    """The number of clients of the soak."""
    minutes: float = 10.0
    """The length of the soak; 0 for none."""
    repeats: int = 5
    """The number of rounds of the comparison; 0 for none."""


FULL_CASE = ServeCase()  # The case of published figures.
# The case of `--quick`.
QUICK_CASE = ServeCase(
    "procedural:street?seed=3&frames=2&width=160&height=96&gaussians=60000",
    scale=1.0,
    num_frames=2,
    minutes=0.1,
    repeats=1,
)


def measure(case: ServeCase) -> Figures:
    """Measure the service on a scene.

    Args:
        case: The sizes.
    """
    machine = machine_facts()
    tables = []
    facts: Figures = {"scene": case.scene, "recipe": case.recipe, "scale": case.scale}
    if case.repeats > 0:
        facts["rate"] = _measure_rate(case)
        tables.append(_rate_table(facts["rate"]))
    if case.minutes > 0:
        facts["soak"] = _measure_soak(case)
        tables.append(_soak_table(facts["soak"]))
    return figures("serve", tables, machine=machine, **facts)


# ---- The requests of a closed loop ---------------------------------------------------------------


class ClosedLoop:
    """Requests of a simulator: one batch of all cameras for each step along the recorded path.

    Args:
        stub: The service.
        scale: The size of the images over the recorded size.
        image_format: A name of ImageFormat.
    """

    def __init__(self, stub: Stub, scale: float, image_format: str = "JPEG") -> None:
        self._scene = stub.get_available_scenes(message_class("common.Empty")()).scene_ids[0]
        request = message_class("AvailableCamerasRequest")(scene_id=self._scene)
        self._cameras = stub.get_available_cameras(request).available_cameras
        request = message_class("AvailableTrajectoriesRequest")(scene_id=self._scene)
        answer = stub.get_available_trajectories(request)
        self._path = answer.available_trajectories[0].trajectory.poses
        self._scale = scale
        self._format = enum_numbers("ImageFormat")[image_format]

    @property
    def num_cameras(self) -> int:
        """The number of images of a step."""
        return len(self._cameras)

    def step(self, number: int, max_aside_m: float = MAX_ASIDE_M) -> Any:
        """Return the request of a step; the path begins anew after its last pose.

        Args:
            number: The number of the step.
            max_aside_m: The distance from the recorded line, at most.
        """
        recorded = self._path[number % len(self._path)]
        world_from_rig = pose_matrix(recorded.pose, "pose")
        aside_m = max_aside_m * math.sin(math.pi * number / SWING_STEPS)
        world_from_rig[:3, 3] += aside_m * world_from_rig[:3, 1]
        batch = message_class("BatchRGBRenderRequest")()
        for camera in self._cameras:
            spec = camera.intrinsics
            request = batch.items.add(camera_name=camera.logical_id).request
            request.scene_id = self._scene
            request.camera_intrinsics.CopyFrom(spec)
            request.resolution_w = max(1, round(spec.resolution_w * self._scale))
            request.resolution_h = max(1, round(spec.resolution_h * self._scale))
            request.frame_start_us = recorded.timestamp_us
            request.frame_end_us = recorded.timestamp_us + 1
            pose = pose_message(world_from_rig @ pose_matrix(camera.rig_to_camera, "pose"))
            request.sensor_pose.start_pose.CopyFrom(pose)
            request.sensor_pose.end_pose.CopyFrom(pose)
            request.image_format = self._format
            request.image_quality = 95.0
        return batch


def _send(stub: Stub, request: Any) -> None:
    """Send the request of a step; raise RuntimeError where an image failed."""
    for item in stub.batch_render_rgb(request, timeout=DEADLINE_S).items:
        if not item.success:
            raise RuntimeError(f"camera {item.camera_name}: {item.error_message}")


def _channel(port: int) -> Any:
    """Return a channel to a server of this machine."""
    options = [("grpc.max_receive_message_length", MAX_MESSAGE_BYTES)]
    return grpc.insecure_channel(f"127.0.0.1:{port}", options=options)


# ---- The service beside a job --------------------------------------------------------------------


def _measure_rate(case: ServeCase) -> Figures:
    """Return the images a second and the processor time of the service and of a job."""
    options = ServeOptions(scenes=(f"scene={case.scene}",), recipe=(case.recipe,), port=0)
    recipes = served_recipes(options.recipe, 1, IMAGES_ONLY)
    with (
        start_service(options, recipes) as running,
        running.store.borrow("scene") as (opened, recipe),
        _channel(running.port) as channel,
        tempfile.TemporaryDirectory() as folder,
    ):
        stub = Stub(channel)
        image_format = "PNG" if recipe.output.image == "png" else "JPEG"
        loop = ClosedLoop(stub, case.scale, image_format)
        job_recipe = recipe.model_copy(
            update={"render": recipe.render.model_copy(update={"scale": case.scale})}
        )
        frames = [frame.index for frame in opened.scene.frames][: case.num_frames]
        num_images = len(frames) * loop.num_cameras

        def serve() -> None:
            for number in range(len(frames)):
                _send(stub, loop.step(number, 0.0))

        def run() -> None:
            job = RenderJob("scene", [job_recipe], Path(folder), frames=frames, overwrite=True)
            result = run_job(job, scene_loader=lambda _uri: opened.scene, progress=False)
            if result.written != num_images:
                raise RuntimeError(f"{variant_name(job_recipe)}: {'; '.join(result.failures)}")

        actions: dict[str, Callable[[], None]] = {"service": serve, "job": run}
        wall_s: dict[str, list[float]] = {name: [] for name in actions}
        processor_s: dict[str, list[float]] = {name: [] for name in actions}
        for repeat in range(case.repeats + 1):
            for name in alternate_order(actions, repeat):
                start_wall_s = time.perf_counter()
                start_processor_s = time.process_time()
                actions[name]()
                if repeat > 0:  # the first round compiles and fills caches
                    wall_s[name].append(time.perf_counter() - start_wall_s)
                    processor_s[name].append(time.process_time() - start_processor_s)
    ratios = [job / service for job, service in zip(wall_s["job"], wall_s["service"], strict=True)]
    return {
        "images": num_images,
        "images_per_s": {n: num_images / float(np.median(s)) for n, s in wall_s.items()},
        "processor_ms_per_image": {
            n: 1e3 * float(np.median(s)) / num_images for n, s in processor_s.items()
        },
        "service_over_job": float(np.median(ratios)),
        "service_over_job_of_rounds": ratios,
    }


def _rate_table(facts: Figures) -> Table:
    rows = [
        [name, facts["images_per_s"][name], facts["processor_ms_per_image"][name]]
        for name in ("service", "job")
    ]
    ratio = facts["service_over_job"]
    return Table(
        f"Images by the service and by a job, {facts['images']} a round, in turns",
        ["by", "images/s", "processor ms/image"],
        rows,
        f"images a second of the service over the job's: {ratio:.2f} (median of rounds)",
    )


# ---- A soak --------------------------------------------------------------------------------------


@dataclass(eq=False)
class _Soak:
    """Observations of a soak."""

    end_s: float
    """The time at which clients stop, as of `time.monotonic`."""
    latencies: list[tuple[float, float]] = field(default_factory=list)
    """The end of each step and the seconds that it took."""
    memory: list[tuple[float, float]] = field(default_factory=list)
    """Times, and the server's resident memory then, MiB."""
    errors: list[str] = field(default_factory=list)
    """The texts of steps that failed."""


def _measure_soak(case: ServeCase) -> Figures:
    """Return the latencies of clients that replay closed loops, and the server's memory."""
    with _server_process(case) as (process, port):
        start_s = time.monotonic()
        soak = _Soak(start_s + 60 * case.minutes)
        clients = [
            threading.Thread(target=_run_client, args=(port, case.scale, number, soak))
            for number in range(case.clients)
        ]
        for client in clients:
            client.start()
        while any(client.is_alive() for client in clients):
            soak.memory.append((time.monotonic(), _resident_mib(process.pid)))
            time.sleep(MEMORY_PERIOD_S)
    warm_s = start_s + WARM_UP_SHARE * 60 * case.minutes
    latencies_s = np.array([seconds for end_s, seconds in soak.latencies if end_s >= warm_s])
    memory = np.array([mib for at_s, mib in soak.memory if at_s >= warm_s])
    if not len(latencies_s) or not len(memory):
        raise RuntimeError(f"no step was finished: {'; '.join(soak.errors[:3])}")
    third = max(1, len(memory) // 3)
    p50_s, p99_s = np.percentile(latencies_s, (50, 99))
    first_mib = float(np.median(memory[:third]))
    last_mib = float(np.median(memory[-third:]))
    return {
        "minutes": case.minutes,
        "clients": case.clients,
        "steps": len(soak.latencies),
        "failed_steps": len(soak.errors),
        "errors": soak.errors[:5],
        "p50_ms": 1e3 * float(p50_s),
        "p99_ms": 1e3 * float(p99_s),
        "max_ms": 1e3 * float(latencies_s.max()),
        "p99_over_p50": float(p99_s / p50_s),
        "first_third_mib": first_mib,
        "last_third_mib": last_mib,
        "memory_growth": last_mib / first_mib - 1,
        "memory_peak_mib": float(memory.max()),
    }


@contextmanager
def _server_process(case: ServeCase) -> Iterator[tuple[subprocess.Popen[str], int]]:
    """Run `climategs serve` in a process of its own; yield it and its port."""
    words = ["serve", f"scene={case.scene}", "--recipe", case.recipe, "--port", "0"]
    command = [sys.executable, "-m", "tools.cli", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            assert process.stdout is not None
            line = process.stdout.readline()
            if " at " not in line:
                raise RuntimeError("the server did not start; its messages are above")
            yield process, int(line.split(" at ")[1].split()[0].rpartition(":")[2])
        finally:
            process.terminate()


def _run_client(port: int, scale: float, client_number: int, soak: _Soak) -> None:
    """Replay the closed loop until the soak ends. Clients begin at different places of the path."""
    with _channel(port) as channel:
        stub = Stub(channel)
        loop = ClosedLoop(stub, scale)
        number = 7 * client_number
        while time.monotonic() < soak.end_s:
            request = loop.step(number)
            start_s = time.monotonic()
            try:
                _send(stub, request)
            except (grpc.RpcError, RuntimeError) as error:
                soak.errors.append(str(error))
                time.sleep(1.0)
            else:
                end_s = time.monotonic()
                soak.latencies.append((end_s, end_s - start_s))
            number += 1


def _resident_mib(pid: int) -> float:
    """Return the resident memory of a process, MiB."""
    pages = int(Path(f"/proc/{pid}/statm").read_text().split()[1])
    return pages * os.sysconf("SC_PAGE_SIZE") / 2**20


def _soak_table(facts: Figures) -> Table:
    growth = 100 * facts["memory_growth"]
    return Table(
        f"A soak of {facts['minutes']:g} min with {facts['clients']} clients",
        ["steps", "failed", "p50 ms", "p99 ms", "p99/p50", "MiB, first third", "MiB, last third"],
        [
            [
                facts["steps"],
                facts["failed_steps"],
                facts["p50_ms"],
                facts["p99_ms"],
                facts["p99_over_p50"],
                facts["first_third_mib"],
                facts["last_third_mib"],
            ]
        ],
        f"a step is one batch of all cameras; memory grew by {growth:.1f} %; the first "
        f"{100 * WARM_UP_SHARE:.0f} % of the time are not counted",
    )
