"""Where points lie in the pictures of a scene's training views."""

import math

import torch


def film(scene, view, p):
    """Film coordinates [n, 2] of points [n, 3] in the training cameras ``view`` [n]."""
    camera = scene.train[0].camera
    pose = torch.stack([torch.as_tensor(v.camera.to_world, dtype=torch.float64) for v in scene.train])[view]
    local = ((p.double() - pose[:, :3, 3]).unsqueeze(1) @ pose[:, :3, :3]).squeeze(1)
    pixel = 2 * math.tan(camera.fov_x / 2) / camera.width
    x, y = local[:, 0] / -local[:, 2] / pixel, local[:, 1] / -local[:, 2] / pixel
    return torch.stack((x + camera.width / 2, camera.height / 2 - y), -1)
