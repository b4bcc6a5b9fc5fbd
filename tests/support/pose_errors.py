"""Datasets of poses whose errors follow a known law of distance, side and viewing angle."""

import runpy
from pathlib import Path

import numpy as np
import tomlkit

from support.small_datasets import perfect
from sweep.analysis.dataset import viewing_angle_of
from sweep.model.pose import rotation_of_vector, vector_of_rotation

FX, SIZE_M = 900.0, 0.165

READER = Path(__file__).parents[2] / "pipelines" / "pose_errors.py"


def reader_of_the_guide():
    """Return the function without packages that users copy to read error models."""
    return runpy.run_path(READER)["pose_errors"]


def minimal_turn(direction):
    """Return rotations of (0, 0, 1) to unit vectors (..., 3) by the shortest way, by Rodrigues."""
    z = np.array([0.0, 0.0, 1.0])
    axis = np.cross(np.broadcast_to(z, direction.shape), direction)
    sine = np.linalg.norm(axis, axis=-1, keepdims=True)
    angle = np.arctan2(sine, direction[..., 2:])
    return rotation_of_vector(axis / np.where(sine > 0, sine, 1.0) * angle)


def poses_with_law(seed, axes, law, *, bearing_deg=0.0, normal=None, drawn=None):
    """Return a dataset; ``law(distance, side, angle)`` gives bias and sigma (..., 6) in sight.

    ``axes``: distance_m, tilt_deg, optionally size_m and solver, and trial; a law of solvers gets
    the same values for each. ``normal`` draws the unit errors: ``normal(rng, shape)``; ``drawn``
    gives parameters that are no axes, by name: ``drawn(rng, shape)``.
    """
    rng = np.random.default_rng(seed)
    scene = [name for name in axes if name != "solver"]
    shape = tuple(len(axes[name]) for name in scene)
    grid = dict(zip(scene, np.meshgrid(*(axes[n] for n in scene), indexing="ij"), strict=True))
    values = {} if drawn is None else drawn(rng, shape)
    grid |= values
    z, tilt = grid["distance_m"], np.radians(grid["tilt_deg"])
    bearings = np.tan(np.radians(rng.uniform(-bearing_deg, bearing_deg, (2, *shape))))
    position = np.stack([z * bearings[0], z * bearings[1], z], axis=-1)
    azimuth = rng.uniform(0, 2 * np.pi, shape)
    axis = np.stack([np.cos(azimuth), np.sin(azimuth), np.zeros(shape)], axis=-1)
    turned = rotation_of_vector(axis * tilt[..., None])
    rotation = turned @ rotation_of_vector(np.array([np.pi, 0.0, 0.0]))
    rvec = vector_of_rotation(rotation.reshape(-1, 3, 3)).reshape(*shape, 3)
    side = FX * grid.get("size_m", SIZE_M) / z
    bias, sigma = law(z, side, viewing_angle_of(rvec, position))
    draw = normal or (lambda rng, size: rng.normal(size=size))
    unit = position / np.linalg.norm(position, axis=-1, keepdims=True)
    turn = minimal_turn(unit)
    sizes = {name: len(axes[name]) for name in (*scene, "solver") if name in axes}
    drawn_errors = np.stack([draw(rng, (*shape, 6)) for _ in axes.get("solver", [0])], axis=-2)
    errors = bias[..., None, :] + sigma[..., None, :] * drawn_errors
    turned = [np.einsum("...ij,...kj->...ki", turn, errors[..., k : k + 3]).reshape(
        *sizes.values(), 3) for k in (0, 3)]
    results = perfect(rng, sizes, position=turned[0], rotation=turned[1]).assign(
        true_rvec=((*scene, "xyz"), rvec), true_tvec_m=((*scene, "xyz"), position),
        marker_area_px=(scene, side**2))
    listed = {name: list(map(float, axes[name])) for name in scene if name != "trial"}
    return results.assign_coords(
        {name: list(values) for name, values in axes.items()}
        | {name: (scene, each) for name, each in values.items()}
    ).assign_attrs(pipeline=tomlkit.dumps({
        "seed": 1, "camera": {"width_px": 1280, "height_px": 800, "fx_px": FX},
        "marker": {} if "size_m" in axes else {"size_m": SIZE_M},
        "pose": {"azimuth_deg": {"uniform": [0, 360]}} | (
            {} if "distance_m" in axes else {"distance_m": 1}),
        "axes": listed | {"trial": 9},
    }))


def power_law(distance, side, angle):  # noqa: ARG001
    """Return bias and sigma (..., 6): powers of the distance, exponential in the angle."""
    ends = np.array([2.0, 2.0, 2.5, 1.5, 1.5, 1.0])
    scale = np.array([1e-4, 1e-4, 1e-3, 2e-3, 2e-3, 1e-3])
    sigma = scale * distance[..., None] ** ends * np.exp(0.01 * angle[..., None])
    bias = np.zeros_like(sigma)
    bias[..., 2] = 0.004 * distance  # 0.4 % of the distance
    return bias, sigma
