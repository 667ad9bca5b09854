"""A closed loop against `climategs serve`: six cameras, ten steps a second, off the recorded line.

Run it with: python docs/examples/closed_loop.py OUTPUT_FOLDER
It starts the server of a small street. The car leaves the recorded line by up to 2 m, as under a
planner. The picture shows the last step in clear air and in fog.
"""

import subprocess
import sys
import time
from pathlib import Path

import cv2
import grpc
import numpy as np

from tools.serve.messages import Stub, message_class
from tools.serve.poses import pose_matrix, pose_message

STREET = "procedural:street?seed=3&gaussians=60000&frames=5&width=320&height=180"


def main(output_dir: Path, address: str) -> None:
    """Replay the recorded path, shifted to the left, and write closed_loop.png."""
    renderer = Stub(grpc.insecure_channel(address))
    scene = renderer.get_available_scenes(message_class("common.Empty")()).scene_ids[0]
    request = message_class("AvailableCamerasRequest")(scene_id=scene)
    cameras = renderer.get_available_cameras(request).available_cameras
    request = message_class("AvailableTrajectoriesRequest")(scene_id=scene)
    path = renderer.get_available_trajectories(request).available_trajectories[0].trajectory.poses

    def render_step(number: int, weather: str) -> list[np.ndarray]:
        world_from_rig = pose_matrix(path[number].pose, "pose")
        world_from_rig[:3, 3] += 2 * number / (len(path) - 1) * world_from_rig[:3, 1]
        batch = message_class("BatchRGBRenderRequest")()
        for camera in cameras:
            request = batch.items.add(camera_name=camera.logical_id).request
            request.scene_id = scene + weather
            request.camera_intrinsics.CopyFrom(camera.intrinsics)
            request.frame_start_us = path[number].timestamp_us
            request.frame_end_us = request.frame_start_us + 1
            pose = pose_message(world_from_rig @ pose_matrix(camera.rig_to_camera, "pose"))
            request.sensor_pose.start_pose.CopyFrom(pose)
            request.image_format = 1  # PNG
        images = [item.result.image_bytes for item in renderer.batch_render_rgb(batch).items]
        return [cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_COLOR) for data in images]

    for number in range(len(path)):
        start_s = time.perf_counter()
        foggy = render_step(number, "@dense-fog")
        print(f"step {number}: {len(foggy)} images, {time.perf_counter() - start_s:.2f} s")
    picture = np.hstack([render_step(len(path) - 1, "@clear")[0], foggy[0]])
    output_dir.mkdir(parents=True, exist_ok=True)
    cv2.imwrite(str(output_dir / "closed_loop.png"), picture)
    print(f"picture: {output_dir / 'closed_loop.png'}")


if __name__ == "__main__":
    words = [sys.executable, "-m", "tools.cli", "serve", STREET, "--port", "0"]
    words += ["--recipe", "clear", "--recipe", "dense-fog"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as server:
        main(Path(sys.argv[1]), server.stdout.readline().split(" at ")[1].split()[0])
        server.terminate()
