"""Places at which the whole marker is in the frame.

Along x only the frame's left and right edges bound a marker, along y only its upper and lower one.
A point of the marker that lies (o_x, o_y, o_z) from its centre is in the frame if the pixel of
(x + o_x)/(z + o_z) is. Without a lens that bounds x by the points' offsets and depths alone; with
one, an edge of the frame is a curve, and the limits along x depend on y. So do all of them if the
marker is turned against the line of sight. Then the place is a fixed point: x at its share between
the limits at (x, y), and y at its.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sweep.model import lens as lens_model
from sweep.model.camera import Cameras
from sweep.typing import Floats, Masks

MAX_STEPS = 200
"""Steps of the fixed point: each gains a digit or more, unless the lens folds in the frame."""

CONVERGED = 1e-12
"""Step, relative to the depth, at which the fixed point is reached."""

HALVINGS = 50
"""Bisections between a place that is in the frame and one that is not."""

SLACK_PX = 1e-6
"""Pixels by which a point may be beyond the frame's edge: rounding, where it lies upon it."""

PER_SIDE = 8
"""Points of a side that is bent by a lens; between them it bulges by less than 1/64 of the side's
bulge, which :data:`BULGE_PX` covers up to 3 px."""

BULGE_PX = 0.05
"""Pixels that are kept free at the frame's edges under a lens."""


@dataclass(frozen=True, slots=True)
class Framing:
    """Where N markers are to be between the places at which they touch the frame.

    Attributes
    ----------
    cameras, frame
        N cameras, and (N, 2) width and height of their frames in px.
    depth
        (N,) of the marker's centre, in metres.
    offsets
        Returns the points (n, M, 3) of the markers of rows (n,), from the centre, in the camera's
        frame, if the centre is at (x, y) (n, 2): the corners, or points along the sides.
    share
        (N, 2) between the first (0) and the last (1) place along x and y; NaN: along this axis the
        marker stays at ``given``.
    given
        (N, 2) x and y, metres, where there is no share.
    margin, shift
        (N, 2) metres: free space that is kept at both ends, and what is added to the place
        afterwards (at most the margin).
    """

    cameras: Cameras
    frame: Floats
    depth: Floats
    offsets: Callable[[NDArray[np.intp], Floats], Floats]
    share: Floats
    given: Floats
    margin: Floats
    shift: Floats

    def centres(self) -> Floats:
        """Return the centres (N, 2) in metres, without ``shift``.

        Along an axis along which a marker is too large to be in the frame, it is in the middle
        between the places at which it touches the two edges.
        """
        wanted = self._solve(self.share)
        outside = np.flatnonzero(~self._fits(np.arange(len(wanted)), wanted))
        if len(outside):
            wanted[outside] = self._nearest(outside, wanted[outside])
        return np.asarray(np.where(np.isnan(self.share), self.given, wanted - self.shift))

    def _solve(self, share: Floats) -> Floats:
        """Return the fixed points (N, 2) of a share (N, 2), with ``shift``."""
        centre_xy = np.where(np.isnan(share), self.given + self.shift, 0.0)
        active = np.arange(len(centre_xy))
        for _ in range(MAX_STEPS):
            moved = self._step(active, centre_xy[active], share[active])
            step = np.abs(moved - centre_xy[active]).max(axis=1)
            centre_xy[active] = moved
            # Each row ends by itself: a scene's place depends on no other scene.
            active = active[step > CONVERGED * (self.depth[active] + np.abs(moved).max(axis=1))]
            if not len(active):
                break
        return centre_xy

    def _step(self, rows: NDArray[np.intp], centre_xy: Floats, share: Floats) -> Floats:
        """Return the places (n, 2) at their share between the limits at ``centre_xy``."""
        low, high = self._limits(rows, centre_xy)
        low, high = low + self.margin[rows], high - self.margin[rows]
        tight = high < low
        chosen = low + np.where(tight, 0.5, share) * (high - low) + self.shift[rows]
        return np.where(np.isfinite(chosen), chosen, centre_xy)

    def _limits(self, rows: NDArray[np.intp], centre_xy: Floats) -> tuple[Floats, Floats]:
        """Return the first and last places (n, 2) along each axis that keep all points inside."""
        offsets = self.offsets(rows, centre_xy)
        depth = self.depth[rows, None] + offsets[..., 2]
        depth = np.where(depth > 0, depth, np.nan)
        ends = []
        for side in (0, 1):
            rays = self._rays(rows, centre_xy, offsets, side)
            ends.append(rays * depth[..., None] - offsets[..., :2])
        return np.asarray(ends[0].max(axis=1)), np.asarray(ends[1].min(axis=1))

    def _rays(
        self, rows: NDArray[np.intp], centre_xy: Floats, offsets: Floats, side: int
    ) -> Floats:
        """Return (n, M, 2) x/z of the left (1: right) and y/z of the upper (lower) edge.

        Under a lens, of the edge's points beside the marker's points.
        """
        cameras = self.cameras.take(rows)
        edge = np.array([-0.5, -0.5]) if side == 0 else self.frame[rows] - 0.5
        edge = np.broadcast_to(edge, (len(rows), 2))
        straight = (edge - cameras.view[:, 2:]) / cameras.view[:, :2]
        rays = np.repeat(straight[:, None, :], offsets.shape[1], axis=1)
        curved = np.flatnonzero(cameras.distorted)
        if not len(curved):
            return rays
        lenses = cameras.take(curved)
        centre = np.column_stack([centre_xy, self.depth[rows]])[curved]
        pixels = lenses.project(offsets[curved] + centre[:, None, :])
        frame = self.frame[rows[curved], None, :]
        inward = BULGE_PX * (1 - 2 * side)
        fold = lenses.lenses[:, 23, None]
        for axis in (0, 1):
            beside = np.clip(np.nan_to_num(pixels), -0.5, frame - 0.5)
            beside[..., axis] = edge[curved, None, axis] + inward
            inverse = lenses.normalise(beside)[..., axis]
            # Where the lens shows nothing up to the edge, its fold is the limit.
            limit = np.where(np.isfinite(fold), fold * (2 * side - 1), rays[curved, :, axis])
            rays[curved, :, axis] = np.where(np.isfinite(inverse), inverse, limit)
        return rays

    def _fits(self, rows: NDArray[np.intp], centre_xy: Floats) -> Masks:
        """Return (n,) whether all points are in the frame along the axes that have a share."""
        offsets = self.offsets(rows, centre_xy)
        centre = np.column_stack([centre_xy, self.depth[rows]])
        cameras = self.cameras.take(rows)
        points = offsets + centre[:, None, :]
        pixels = cameras.project(points)
        inside = (pixels >= -0.5 - SLACK_PX) & (
            pixels <= self.frame[rows, None, :] - 0.5 + SLACK_PX
        )
        inside |= np.isnan(self.share[rows, None, :]) & np.isfinite(pixels)
        fits = np.asarray(inside.all(axis=(1, 2)))
        curved = np.flatnonzero(cameras.distorted & fits)
        if len(curved):
            corners = points[curved, :: max(points.shape[1] // 4, 1)]
            flat = np.ascontiguousarray(corners[..., :2] / corners[..., 2:])
            fits[curved] = ~lens_model.folds(flat, cameras.lenses[curved])
        return fits

    def _nearest(self, rows: NDArray[np.intp], wanted: Floats) -> Floats:
        """Return the last place (n, 2) in the frame on the way from the middle to ``wanted``.

        ``wanted`` itself, if the marker is not wholly in the frame in the middle.
        """
        middle = self._solve(np.where(np.isnan(self.share), np.nan, 0.5))[rows]
        middle = np.where(self._fits(rows, middle)[:, None], middle, wanted)
        inside, outside = np.zeros(len(rows)), np.ones(len(rows))
        for _ in range(HALVINGS):
            half = (inside + outside) / 2
            fits = self._fits(rows, middle + half[:, None] * (wanted - middle))
            inside, outside = np.where(fits, half, inside), np.where(fits, outside, half)
        return np.asarray(middle + inside[:, None] * (wanted - middle))
