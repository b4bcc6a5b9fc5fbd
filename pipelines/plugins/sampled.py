"""A renderer: one sample at each pixel's centre, without antialiasing."""
import numpy as np
from sweep.plugins import RendererPlugin

def render(view):
    left, top, right, bottom = view.box
    v, u = np.mgrid[top:bottom, left:right]
    points = np.stack([u, v, np.ones_like(u)], axis=-1) @ np.linalg.inv(view.homography).T
    with np.errstate(divide="ignore", invalid="ignore"):
        column, row = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
    count, border = len(view.modules), view.quiet_zone_modules
    share = np.maximum(abs(column - count / 2), abs(row - count / 2)) <= count / 2 + border
    on_square = np.maximum(abs(column - count / 2), abs(row - count / 2)) < count / 2
    at = np.where(on_square, row, 0).astype(int), np.where(on_square, column, 0).astype(int)
    white = ~on_square | view.modules[at]
    return np.where(share, np.where(white, view.white, view.black), 0.0), share

RENDERER = RendererPlugin(render=render, meaning="one sample a pixel")
