"""Render foggy images with labels, and train a small network on them to find the road.

Run it with: python docs/examples/train_on_fog.py [OUTPUT_FOLDER]
The network is a toy. The example shows the path of the data: job, output folder, DataLoader.
"""

import sys
from pathlib import Path

import cv2
import torch
from torch import nn
from torch.utils.data import DataLoader

from adapters.base import open_scene
from augment import RenderJob, SemanticClass, WeatherDataset, collate_frames, run_job
from recipes.load import parse_recipe

STREET = "procedural:street?seed=3&gaussians=60000&frames=4&width=160&height=96"
RECIPE = """version: 1
name: fog
weather: {smog: {visibility_m: {log_uniform: [40, 400]}}}
output: {semantic: true}
"""
ROAD = torch.tensor((SemanticClass.ROAD, SemanticClass.LANE_MARKING))


def main(output_dir: Path) -> None:
    """Write fog/ (images and labels) and train_on_fog.png: image, label, prediction."""
    template = parse_recipe(RECIPE, source="train_on_fog.py")
    recipes = [template.resolve(variant) for variant in range(3)]  # three draws of visibility
    job = RenderJob(STREET, recipes, output_dir / "fog", cameras=["front", "front_left"])
    run_job(job, scene_loader=open_scene, progress=False)

    torch.manual_seed(0)
    data = WeatherDataset(output_dir / "fog", load=("image", "semantic"))
    loader = DataLoader(data, batch_size=8, shuffle=True, collate_fn=collate_frames)
    layers = [nn.Conv2d(3, 16, 5, stride=2, padding=2), nn.BatchNorm2d(16), nn.ReLU()]
    layers += [nn.Conv2d(16, 32, 5, stride=2, padding=2), nn.BatchNorm2d(32), nn.ReLU()]
    layers += [nn.Conv2d(32, 1, 5, padding=2), nn.Upsample(scale_factor=4, mode="bilinear")]
    network = nn.Sequential(*layers)
    optimizer = torch.optim.Adam(network.parameters(), lr=0.01)
    for _epoch in range(20):
        for batch in loader:  # image float32 [B, 3, H, W], semantic uint8 [B, H, W]
            is_road = torch.isin(batch["semantic"], ROAD).float()
            logits = network(batch["image"])[:, 0]
            loss = nn.functional.binary_cross_entropy_with_logits(logits, is_road)
            optimizer.zero_grad()
            loss.backward()
            optimizer.step()
    print(f"{len(data)} images; loss {loss.item():.2f} (0.69 is chance)")

    label = is_road[:1].expand(3, -1, -1)
    prediction = logits[:1].detach().sigmoid().expand(3, -1, -1)
    picture = torch.cat([batch["image"][0], label, prediction], dim=2)  # [3, H, 3 W], 0 to 1
    path = output_dir / "train_on_fog.png"
    cv2.imwrite(str(path), (picture * 255).byte().permute(1, 2, 0).numpy()[..., ::-1])
    print(f"picture: {path}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples"))
