"""A solver of boards: Locus' own, which searches the images by itself."""
from dataclasses import dataclass
from functools import lru_cache
import numpy as np
from sweep.adapters.detectors import LOCUS_FAMILIES, LOCUS_PROFILES
from sweep.plugins import EstimatorPlugin, Poses, parameter

# From our board's frame (y up, z out) to Locus', which has the same origin (y down, z in).
Z_IN = np.diag([1.0, -1.0, -1.0])

# Corners (4, 2) of an upright square of side 1.
SQUARE = np.array([[-0.5, 0.5], [0.5, 0.5], [0.5, -0.5], [-0.5, -0.5]])

@dataclass(frozen=True)
class Settings:
    locus_board_profile: str = parameter(
        "standard", "Locus' boards: the shipped profile of settings", choices=LOCUS_PROFILES)
    locus_chessboard: bool = parameter(
        True, "Locus' boards: of a charuco, the corners of its chessboard (CharucoRefiner) in "
        "place of those of its markers (BoardEstimator)")

def make(settings):
    import locus  # noqa: PLC0415  (optional)
    from scipy.spatial.transform import Rotation  # noqa: PLC0415  (slow to import)

    @lru_cache(maxsize=64)
    def tools(board, scale):
        """Return Locus' detector for a board, and its estimator; ValueError if it has none."""
        if board.dictionary not in LOCUS_FAMILIES:
            raise ValueError(f"locus-tag has no family for {board.dictionary}")
        family = getattr(locus.TagFamily, LOCUS_FAMILIES[board.dictionary])
        detector = locus.Detector(
            profile=settings.locus_board_profile, threads=1, families=[family])
        if board.marker_ids != tuple(range(len(board))):
            raise ValueError(
                "locus-tag numbers markers from 0 in reading order: expected marker_id 0")
        squares = board.chessboard
        if squares is None:
            rows, columns, gap_m, side_m = grid_of(board.corners_m)
            return detector, locus.BoardEstimator(
                locus.AprilGrid(rows, columns, gap_m * scale, side_m * scale, family))
        if not (squares.legacy_pattern and squares.squares_y % 2 == 0):
            raise ValueError(
                "locus-tag's charucos have a marker at the top left: expected "
                "legacy_pattern = true and an even number of squares_y")
        charuco = locus.CharucoBoard(
            squares.squares_y, squares.squares_x, squares.square_m * scale,
            squares.marker_m * scale, family)
        chosen = locus.CharucoRefiner if settings.locus_chessboard else (
            locus.BoardEstimator.from_charuco)
        return detector, chosen(charuco)

    def solve(detections):
        count = len(detections.targets)
        poses = Poses(*(np.full((count, *shape), np.nan) for shape in ((3, 3), (3,), (6, 6))))
        for i, (board, image) in enumerate(
            zip(detections.targets, detections.images, strict=True)
        ):
            if detections.cameras.distorted[i]:
                raise ValueError("locus-tag is built without lenses: expected none")
            detector, estimator = tools(board, float(detections.scale[i]))
            fx, fy, cx, cy = detections.cameras.view[i].tolist()
            left, top = detections.origins[i].tolist()
            # The centre of Locus' first pixel is at 0.5.
            camera = locus.CameraIntrinsics(fx, fy, cx - left + 0.5, cy - top + 0.5)
            found = estimator.estimate(detector, np.ascontiguousarray(image), camera)
            if found.board_pose is None:
                continue
            # Quaternions are w, x, y, z there.
            turn = Rotation.from_quat(np.roll(found.board_pose[3:], -1)).as_matrix()
            poses.rotation[i], poses.translation[i] = turn @ Z_IN, found.board_pose[:3]
            if found.board_cov is not None:
                # Theirs is along the board's axes.
                to_camera = np.kron(np.eye(2), turn)
                poses.covariance[i] = to_camera @ found.board_cov @ to_camera.T
        return poses

    return solve

def grid_of(corners_m):
    """Return rows, columns, gap and side of a grid whose markers have corners (n, 4, 3) in metres.

    ValueError for another board.
    """
    (x, y, _), count = (corners_m[:, 1] - corners_m[:, 0])[0], len(corners_m)
    side = float(np.hypot(x, y))
    near = 1e-6 * side  # rounding
    columns = int((np.abs(corners_m[:, 0, 1] - corners_m[0, 0, 1]) < near).sum())
    # To the next of the row, or of the column.
    step = side if count == 1 else float(np.linalg.norm(corners_m[1, 0] - corners_m[0, 0]))
    row, column = np.divmod(np.arange(count), columns)
    places = np.stack([column, -row], axis=1) * step
    off = np.array(corners_m)
    off[..., :2] -= (places - places.mean(axis=0))[:, None] + side * SQUARE
    if count % columns or np.abs(off).max() > near:
        raise ValueError("locus-tag has grids and charucos: expected kind = grid")
    return count // columns, columns, step - side, side

SOLVER = EstimatorPlugin(
    make=make, settings=Settings, needs_images=True, of_boards=True, distribution="locus-tag",
    install="pip install 'fiducial-sweep[locus-tag]'",
    meaning="Locus' own board estimator (locus-tag)")
