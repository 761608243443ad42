"""Render Gaussians of a .ply file with torch, and take the derivative of a loss with respect to all of them.

    python examples/01_render.py [MAP.ply]

Without a file, the example writes one with a colored spiral.
"""

import sys
import tempfile
from pathlib import Path

import duagc  # isort: skip  (before numpy: it sets what makes results reproducible)
import numpy as np
import torch


def write_spiral(path: Path, count: int = 500) -> Path:
    """Write Gaussians on a spiral around the z axis, 2 m before the camera."""
    s = np.linspace(0, 1, count)
    angle = 6 * np.pi * s
    gaussians = duagc.Gaussians(
        ids=np.arange(count),
        anchors=np.zeros(count),
        means=np.stack([s * np.cos(angle), s * np.sin(angle), 2 + s], axis=1),
        quats_wxyz=np.tile([1.0, 0, 0, 0], (count, 1)),
        log_scales=np.full((count, 3), np.log(0.04)),
        colors=np.stack([s, 1 - s, np.full(count, 0.5)], axis=1),
        opacity_logits=np.full(count, 2.0),
    )
    duagc.write_ply(path, gaussians)
    return path


def main() -> None:
    """Render, compare with a gray image, and print the largest gradients."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(sys.argv[1]) if len(sys.argv) > 1 else write_spiral(Path(folder) / "spiral.ply")
        gaussians = duagc.read_ply(path)
    names = ("means", "quats_wxyz", "log_scales", "colors", "opacity_logits")
    tensors = {name: torch.tensor(getattr(gaussians, name), requires_grad=True) for name in names}
    camera = duagc.PinholeCamera(width=320, height=240, fx=260.0, fy=260.0, cx=159.5, cy=119.5)
    color, depth, alpha = duagc.rasterize(**tensors, camera=camera, T_camera_map=np.eye(4))
    loss = ((color - 0.5) ** 2).mean()
    loss.backward()
    print(f"{len(gaussians)} Gaussians, {100 * alpha.mean():.1f} % of the image covered, loss {loss:.4f}")
    print(f"nearest surface {depth[alpha > 0.5].min():.2f} m")
    for name, tensor in tensors.items():
        print(f"largest |d loss / d {name}|: {tensor.grad.abs().max():.2e}")


if __name__ == "__main__":
    main()
