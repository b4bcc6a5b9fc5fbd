"""Pictures of boards in several planes by brute force: each ray takes the nearest sheet."""

import numpy as np

from sweep.model.marker import modules


def traced(markers, dictionary, levels, camera, pose, per_side, ground=None):
    """The mean levels (height, width) of ``per_side``² rays a pixel.

    ``markers``: (ID, centre (3,), rotation (3, 3), size_m) in the target's frame, each on a sheet
    with a quiet zone of one module; ``levels`` of outside, black, white; ``camera``: width, height,
    f, cx, cy; ``pose``: rotation and translation of the target. ``ground``: returns the level of
    points (n, 2) of the target's plane, NaN where nothing is printed.
    """
    width, height, focal, cx, cy = camera
    rotation, translation = pose
    u = (np.arange(width * per_side) + 0.5) / per_side - 0.5
    v = (np.arange(height * per_side) + 0.5) / per_side - 0.5
    x, y = np.meshgrid((u - cx) / focal, (v - cy) / focal)
    rays = np.stack([x, y, np.ones_like(x)], axis=-1)
    nearest, level = np.full(x.shape, np.inf), np.full(x.shape, float(levels[0]))
    if ground is not None:
        depth = rotation[:, 2] @ translation / (rays @ rotation[:, 2])
        points = (rays * depth[..., None] - translation) @ rotation[:, :2]
        seen = ground(points.reshape(-1, 2)).reshape(x.shape)
        hit = np.isfinite(seen) & (depth > 0)
        nearest[hit], level[hit] = depth[hit], seen[hit]
    for marker_id, centre, turn, size in markers:
        axes, middle = rotation @ turn, rotation @ centre + translation
        if axes[:, 2] @ middle >= 0:
            continue  # its back
        depth = axes[:, 2] @ middle / (rays @ axes[:, 2])
        at = rays * depth[..., None] - middle
        bits = modules(dictionary, marker_id)
        count = len(bits)
        column = (at @ axes[:, 0] / size + 0.5) * count
        line = (0.5 - at @ axes[:, 1] / size) * count
        hit = (depth > 0) & (depth < nearest)
        for along in (column, line):
            hit &= (along >= -1) & (along < count + 1)
        within = (column >= 0) & (column < count) & (line >= 0) & (line < count)
        index = [np.clip(along, 0, count - 1).astype(int) for along in (line, column)]
        white = ~within | bits[tuple(index)]
        nearest[hit] = depth[hit]
        level[hit] = np.where(white, levels[2], levels[1])[hit]
    return level.reshape(height, per_side, width, per_side).mean(axis=(1, 3))
