"""Train a tiny detector of cars; run it with: python docs/examples/train_detector.py [FOLDER]"""

import sys
from pathlib import Path

import cv2
import torch
from torch import nn

from augment import WeatherDataset
from augment.dataset import torchvision_sample
from tools.cli import main as climategs

STREET = "procedural:street?seed=1&gaussians=60000&frames=25&speed_mps=20&width=160&height=96"
RENDER = ["render", "clear", "--cameras", "front,front_left", "--scene", STREET, "--out"]


def make_target(boxes):
    """Return a map [5, 24, 40]: 1 in a box's middle to 0 outside, and distances from its sides."""
    y, x = torch.meshgrid(torch.arange(24), torch.arange(40), indexing="ij")
    points = 4 * torch.stack([x, y]) + 2  # the middles of cells of 4 x 4 pixels
    target = torch.cat([torch.zeros(1, 24, 40), torch.ones(4, 24, 40)])
    for box in boxes[..., None, None]:  # left, top, right, bottom
        sides = torch.cat([points - box[:2], box[2:] - points]).clamp(min=0.01)
        middle = (sides / sides.roll(2, 0)).clamp(max=1).prod(0, keepdim=True).sqrt()
        target = torch.where(middle > target[:1], torch.cat([middle, sides]), target)
    return target


def train(folder):
    """Return a network that learnt from an output folder, and its last images and heat maps."""
    samples = WeatherDataset(folder, load=("image", "boxes"))
    data = [torchvision_sample(s, label_ids={"Car": 1}, bounds="modal") for s in samples]
    images = torch.stack([image for image, _ in data])  # float32 [N, 3, 96, 160]
    targets = torch.stack([make_target(labels["boxes"]) for _, labels in data])
    torch.manual_seed(0)
    layers = []
    for inputs, outputs, stride in ((3, 16, 2), (16, 32, 2), (32, 32, 1), (32, 32, 1)):
        layers += [nn.Conv2d(inputs, outputs, 5, stride, 2), nn.BatchNorm2d(outputs), nn.ReLU()]
    network = nn.Sequential(*layers, nn.Conv2d(32, 5, 1))
    optimizer = torch.optim.Adam(network.parameters(), lr=0.005)
    for rows in torch.randint(len(images), (300, 8)):
        middle, sides = targets[rows].split([1, 4], dim=1)
        logits, log_sides = network(images[rows]).split([1, 4], dim=1)
        loss = nn.functional.binary_cross_entropy_with_logits(logits, middle)
        loss += ((log_sides - (sides / 10).log()).abs() * middle).sum() / middle.sum() / 5
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return network.eval(), images[rows], middle, logits.detach().sigmoid()


def main(output_dir: Path) -> None:
    """Write street/ (images and labels) and train_detector.png: image, true and learnt heat map."""
    climategs([*RENDER, str(output_dir / "street")])
    _, images, *maps = train(output_dir / "street")
    panels = [nn.functional.interpolate(heat, (96, 160)).expand(-1, 3, -1, -1) for heat in maps]
    picture = torch.cat([images, *panels], dim=3)[0].mul(255).byte()  # [3, H, 3 W]
    cv2.imwrite(f"{output_dir}/train_detector.png", picture.permute(1, 2, 0).numpy()[..., ::-1])
    print(f"picture: {output_dir}/train_detector.png")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "out/examples"))
