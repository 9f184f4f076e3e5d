"""Photographs in memory of a room whose walls have a smooth texture, as cameras all around see it."""

import math
from dataclasses import replace

import numpy as np
import torch
from scipy.spatial.transform import Rotation

from helpers.lamp_room import Photographs
from neurad.core.camera import camera_rays
from neurad.scene.builtin.shapes import look_at

SIZE = 96
CAMERAS = [
    look_at((0.8 * x, 0.2 + 0.1 * i, 0.8 * z), (-0.5 * x, -0.3, -0.2 * z), 80.0, SIZE)
    for i, (x, z) in enumerate(((1, 1), (1, 0.4), (1, -0.4), (1, -1), (-1, 1), (-1, 0.4), (-1, -0.4), (-1, -1)))
]


class Photos(Photographs):
    def ignored(self):
        return None


def pattern(p, seed=0, wavelengths=(0.2, 0.5)):
    """A smooth texture of places [..., d]: the exponential of waves."""
    rng = np.random.default_rng(seed)
    way = rng.normal(size=(16, p.shape[-1]))
    way *= 2 * math.pi / (rng.uniform(*wavelengths, (16, 1)) * np.linalg.norm(way, axis=-1, keepdims=True))
    return torch.exp(
        0.25 * torch.sin(p.double() @ torch.from_numpy(way).T + torch.from_numpy(rng.uniform(0, 7, 16))).sum(-1)
    )


def photographed(world, cameras, texture=pattern, noise=0.02):
    """What cameras see of walls with a texture, each with a gain of its own."""
    rng = np.random.default_rng(1)
    pictures = []
    for index, camera in enumerate(cameras):
        y, x = torch.meshgrid(torch.arange(camera.height) + 0.5, torch.arange(camera.width) + 0.5, indexing="ij")
        shown = texture(world.intersect(camera_rays(camera, torch.stack((x, y), -1).view(-1, 2))).p)
        shown = shown * torch.from_numpy(1 + noise * rng.normal(size=len(shown))) * (1 + 0.1 * index)
        pictures.append(shown.float()[:, None].expand(-1, 3))
    return Photos(torch.nn.utils.rnn.pad_sequence(pictures, batch_first=True))  # of unlike sizes, too


def turned(camera, degrees, seed):
    axis = np.random.default_rng(seed).normal(size=3)
    pose = np.asarray(camera.to_world, np.float64).copy()
    pose[:3, :3] = Rotation.from_rotvec(math.radians(degrees) * axis / np.linalg.norm(axis)).as_matrix() @ pose[:3, :3]
    return replace(camera, to_world=pose)
