"""Cameras in the files of calibration programs: OpenCV, ROS, Kalibr, PhotonVision."""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple
from xml.etree import ElementTree as ET

import numpy as np
import yaml

from sweep.messages import nearest, plain
from sweep.model.lens import COUNTS
from sweep.typing import Floats

# --------------------------------------------------------------------------------------------------
# Cameras in the files of calibration programs: OpenCV, ROS, Kalibr, PhotonVision.
#
# All of them put pixel (0, 0) at the centre of the top left pixel and have OpenCV's lens model
# (Kalibr's and ROS's names for it: radtan, plumb_bob, rational_polynomial). They differ in names
# and in forms of numbers, which the tables below have. Names are compared without case and without
# what is no letter or digit.

MATRIX = ("cameramatrix", "intrinsicmatrix", "cameraintrinsics", "intrinsics", "k", "m", "mtx")
DISTORTION = (
    "distortioncoefficients", "distortioncoeffs", "distcoeffs", "distcoeff", "distortion", "dist",
    "d",
)
SIZE = ("imagesize", "resolution", "imgsize", "framesize", "calibrationsize")
SD = ("stddeviationsintrinsics", "stddevintrinsics", "stddevsintrinsics")
COVARIANCE = ("covarianceintrinsics", "intrinsicscovariance")

MODEL_NAMES = ("distortionmodel", "lensmodel", "distortiontype")
#: Lens model -> the numbers of coefficients that it may have.
MODEL_COUNTS = {
    "plumbbob": (0, 4, 5), "radtan": (0, 4), "radialtangential": (0, 4), "none": (0,),
    "rationalpolynomial": (0, 4, 5, 8, 12, 14), "brownconrady": (0, 4, 5), "": COUNTS,
    "lensmodelpinhole": (0,), "lensmodelopencv": COUNTS, "lensmodelopencv4": (4,),
    "lensmodelopencv5": (5,), "lensmodelopencv8": (8,), "lensmodelopencv12": (12,),
}

_FRAME_AS_SENT = "give the calibration of the frame as it is sent"

#: Names, the values that entries of these names may have, and why others are refused.
ALLOWED: tuple[tuple[tuple[str, ...], Iterable[str], str], ...] = (
    (("xi",), (), "camera model omnidirectional (xi): not supported, only pinhole cameras are"),
    (("cameramodel",), ("pinhole", ""),
     "camera model {value}: not supported, only pinhole cameras are"),
    (("fisheyemodel",), ("0", "false", "no", ""),
     "a fisheye model: not supported, only OpenCV's pinhole lens model is"),
    (MODEL_NAMES, MODEL_COUNTS,
     "lens model {value}: not supported; only OpenCV's is (" + "plumb_bob, rational_polynomial, "
     "radtan, none)"),
    (("binningx", "binningy"), ("0", "1"),
     "{name} = {value}: the matrix is that of the frame without binning; " + _FRAME_AS_SENT),
)

KINDS = (
    "a file of OpenCV's FileStorage (camera_matrix, distortion_coefficients, image_width, "
    "image_height), ROS (camera_info), Kalibr (camchain) or PhotonVision"
)


@dataclass(frozen=True, slots=True)
class Calibration:
    """A camera as a file describes it.

    Attributes
    ----------
    width_px, height_px
        The frame that it holds for; None if the file does not say.
    fx_px, fy_px, cx_px, cy_px
        Focal lengths and principal point.
    distortion
        Coefficients in OpenCV's order.
    sd
        Standard deviations of fx, fy, cx, cy (px) and of the coefficients; empty if not given.
    covariance
        Their covariance matrix, row by row; empty if not given.
    """

    width_px: int | None
    height_px: int | None
    fx_px: float
    fy_px: float
    cx_px: float
    cy_px: float
    distortion: tuple[float, ...]
    sd: tuple[float, ...]
    covariance: tuple[float, ...]


def calibration_of(tree: Any, camera: str = "") -> Calibration:
    """Return the camera of a file's tree; ``camera`` is the name of one of several.

    Raises
    ------
    ValueError
        Why there is none, in words that follow the file's name and a colon.
    """
    cameras = _cameras(tree)
    if not cameras:
        raise ValueError(f"not a camera file: it has no camera matrix; expected {KINDS}")
    if camera and camera not in cameras:
        known = [name for name in cameras if name]
        raise ValueError(
            f"no camera {plain(camera)}{nearest(camera, known)}"
            + (f"; it has {', '.join(map(plain, known))}" if known else "; it has one, no name")
        )
    if not camera and len(cameras) > 1:
        names = [plain(name) for name in cameras]
        raise ValueError(
            f"{len(names)} cameras: {', '.join(names[:9])}; name one, as in FILE#{names[0]}"
        )
    return _calibration(cameras[camera or next(iter(cameras))])


def _normal(name: object) -> str:
    return re.sub("[^a-z0-9]", "", str(name).lower())


def _cameras(tree: Any) -> dict[str, dict[str, Any]]:
    """Return the cameras of a tree by name; the name of a single one may be empty."""
    if not isinstance(tree, dict):
        return {}
    if _has_matrix(tree):
        return {"": tree}
    listed = tree.get("calibrations")
    if isinstance(listed, list):  # PhotonVision's settings, a camera for each frame size
        return _mapping(
            ("{}x{}".format(*_size(_by_name(node))), node) for node in listed if _has_matrix(node)
        )
    # A stereo pair has entries M1, D1, M2, D2; a single number k1 is a lens coefficient.
    pairs: dict[str, dict[str, Any]] = {}
    for name, value in tree.items():
        match = re.fullmatch(r"(.*?[A-Za-z])_?([0-9]{1,2})", name)
        if match and _normal(match[1]) in MATRIX + DISTORTION and isinstance(value, (list, dict)):
            pairs.setdefault(match[2], dict(tree))[match[1]] = value
    nodes = pairs if any(map(_has_matrix, pairs.values())) else tree
    return {name: node for name, node in nodes.items() if _has_matrix(node)}


class _Entry(NamedTuple):
    """An entry of a file: its name as written, and its value."""

    name: str
    value: Any

    def fault(self, reason: str) -> ValueError:
        """Return the error of its value."""
        return ValueError(f"{plain(self.name)}: {reason}")

    def pixels(self) -> int:
        """Return a side of a frame."""
        numbers, _ = self.numbers()
        if len(numbers) != 1 or not 1 <= numbers[0] <= 100_000 or numbers[0] % 1:
            raise self.fault(f"{plain(self.value)}; expected whole pixels, from 1 to 100000")
        return int(numbers[0])

    def numbers(self) -> tuple[list[float], tuple[int, ...] | None]:
        """Return a list's or a matrix' numbers, row by row, and its shape if it has one."""
        value, shape, single = self.value, None, False
        if isinstance(value, dict):
            if "data" not in value:
                raise self.fault("a matrix without data")
            if "rows" in value and "cols" in value:
                sides = [_Entry(f"{self.name}.{key}", value[key]) for key in ("rows", "cols")]
                shape = tuple(int(each) for side in sides for each in side.numbers()[0])
            # Digits enough for single precision stand for a number of single precision.
            value, single = value["data"], value.get("dt") == "f"
        if isinstance(value, str):
            value = value.split()
        try:
            array = np.array([] if value is None else value, dtype=np.float64)
        except (TypeError, ValueError) as error:
            raise self.fault(f"expected numbers of one shape, as text: {error}") from None
        if not (np.abs(array) < 1e300).all():
            raise self.fault(f"{plain(value)} is not finite")
        shape = array.shape if array.ndim == 2 else shape
        if shape is not None and math.prod(shape) != array.size:
            expected = " x ".join(map(str, shape))
            raise self.fault(f"{expected}, but {array.size} numbers; is it cut short?")
        return array.astype(np.float32 if single else np.float64).ravel().tolist(), shape


def _by_name(node: dict[str, Any]) -> dict[str, _Entry]:
    """Return the entries of a node by normalised name."""
    return {_normal(name): _Entry(str(name), value) for name, value in node.items()}


def _has_matrix(node: Any) -> bool:
    return isinstance(node, dict) and not _by_name(node).keys().isdisjoint(MATRIX)


def _one(named: dict[str, _Entry], names: tuple[str, ...]) -> _Entry | None:
    """Return the first entry with one of some names; ValueError if others have other numbers."""
    written = [named[name] for name in names if name in named]
    for other in written[1:]:
        if other.numbers()[0] != written[0].numbers()[0]:
            both = f"{plain(written[0].name)} and {plain(other.name)}"
            raise ValueError(f"{both} differ: delete one of them from the file")
    return written[0] if written else None


def _calibration(node: dict[str, Any]) -> Calibration:
    named = _by_name(node)
    counts: tuple[int, ...] = COUNTS
    for names, values, refusal in ALLOWED:
        for name, value in (named[each] for each in names if each in named):
            if _normal(value) not in values:
                raise ValueError(refusal.format(name=name, value=plain(value)))
            counts = MODEL_COUNTS[_normal(value)] if names is MODEL_NAMES else counts
    width, height = _size(named)
    region = named["roi"].value if "roi" in named else None
    if isinstance(region, dict):  # ROS: only a part of the frame may be sent
        whole = {"x_offset": 0, "y_offset": 0, "width": width, "height": height}
        for name in sorted(whole.keys() & region.keys()):
            if _Entry(name, region[name]).numbers()[0] not in ([0], [whole[name]]):
                raise ValueError(
                    f"roi with {name} = {plain(region[name])}: the matrix is that of the whole "
                    f"frame; {_FRAME_AS_SENT}"
                )
    view = _matrix(_one(named, MATRIX) or _Entry("", None))
    lens = _one(named, DISTORTION)
    if lens is None and counts != (0,):
        raise ValueError(
            "no distortion coefficients (distortion_coefficients, distCoeffs, D; an empty list "
            "if there is none)"
        )
    distortion = () if lens is None else _distortion(lens, counts)
    count = 4 + len(distortion)
    sd, covariance = _one(named, SD), _one(named, COVARIANCE)
    return Calibration(
        width, height, *view, distortion,
        () if sd is None else _deviations(sd, count),
        () if covariance is None else _covariance(covariance, count),
    )


def _matrix(entry: _Entry) -> tuple[float, float, float, float]:
    """Return fx, fy, cx, cy of a camera matrix, or of Kalibr's list of the four."""
    numbers, shape = entry.numbers()
    if len(numbers) == 4 and _normal(entry.name) == "intrinsics" and shape is None:
        fx, fy, cx, cy = numbers
    elif len(numbers) == 9 and shape in (None, (3, 3)):
        if not any(numbers):
            raise entry.fault("a matrix of zeros: the camera was not calibrated")
        fx, skew, cx, below, fy, cy = numbers[:6]
        if numbers[6:] != [0, 0, 1]:
            raise entry.fault("expected 0, 0, 1 as the last row of a camera matrix")
        if skew != 0 or below != 0:
            raise entry.fault(f"a skew of {skew or below:g} is not supported")
    else:
        raise entry.fault(f"{len(numbers)} numbers; expected a matrix of 3 x 3")
    if not (fx > 0 and fy > 0):
        raise entry.fault(f"focal lengths {fx:g} and {fy:g}; expected above 0")
    return fx, fy, cx, cy


def _distortion(entry: _Entry, counts: tuple[int, ...]) -> tuple[float, ...]:
    numbers, shape = entry.numbers()
    if shape is not None and 1 not in shape and numbers:
        raise entry.fault(f"{shape[0]} x {shape[1]}; expected a row or a column")
    if len(numbers) not in (counts if any(numbers) else COUNTS):
        expected = " or ".join(map(str, counts))
        raise entry.fault(f"{len(numbers)} coefficients; expected {expected} of this lens model")
    return tuple(numbers)


def _size(named: dict[str, _Entry]) -> tuple[int | None, int | None]:
    """Return the frame's width and height; None if the file does not say."""
    for width, height in (("imagewidth", "imageheight"), ("width", "height")):
        if width in named and height in named:
            return named[width].pixels(), named[height].pixels()
    entry = next((named[name] for name in SIZE if name in named), None)
    if entry is None:
        return None, None
    name, value = entry
    if isinstance(value, dict):
        return _size(_by_name(value))
    sides = re.split("[x, ]+", value.strip("[]() ")) if isinstance(value, str) else value
    if not isinstance(sides, list) or len(sides) != 2:
        raise entry.fault(f"{plain(value)}; expected width and height")
    return _Entry(name, sides[0]).pixels(), _Entry(name, sides[1]).pixels()


_OF_EACH = "of fx, fy, cx, cy and each coefficient"


def _deviations(entry: _Entry, count: int) -> tuple[float, ...]:
    """Return the first ``count`` standard deviations of OpenCV's list of up to 18."""
    numbers, _ = entry.numbers()
    if len(numbers) < count or any(numbers[count:]):
        raise entry.fault(f"{len(numbers)} numbers; expected {count}: {_OF_EACH}")
    if min(numbers) < 0:
        raise entry.fault("a standard deviation below 0")
    return tuple(numbers[:count])


def _covariance(entry: _Entry, count: int) -> tuple[float, ...]:
    """Return the leading ``count`` x ``count`` numbers of a covariance matrix."""
    numbers, _ = entry.numbers()
    side = math.isqrt(len(numbers))
    if side * side != len(numbers) or side < count:
        raise entry.fault(f"{len(numbers)} numbers; expected {count} x {count}: {_OF_EACH}")
    return tuple(np.reshape(numbers, (side, side))[:count, :count].ravel().tolist())


# --------------------------------------------------------------------------------------------------
# The tree of a file in YAML, JSON or OpenCV's XML: dictionaries, lists and scalars.
#
# Scalars of YAML and XML stay text, as written: what is a number is decided by who expects one.
# Tags make no objects.

#: The largest file that is read; a calibration with all its image points is a tenth of that.
MAX_BYTES = 4_000_000

_COMMENT = re.compile(r"^[ \t]*//[^\n]*$", re.MULTILINE)


def read_tree(content: bytes) -> Any:
    """Return the tree of a file's content.

    Bytes that are not UTF-8 may be a comment, or a date in the locale's encoding: no camera's
    numbers are outside of ASCII.

    Raises
    ------
    ValueError
        Why it has none, in words that follow the file's name and a colon.
    """
    text = content.decode("utf-8-sig", errors="replace").strip()
    if not text:
        raise ValueError("empty")
    if "\0" in text:
        raise ValueError("not text, or compressed, or not UTF-8")
    try:
        if text.startswith("<"):
            return _element(ET.fromstring(text))  # noqa: S314  (Expat bounds entities)
        if text.startswith("{"):
            # OpenCV writes comments into JSON, each on a line of its own.
            return json.loads(_COMMENT.sub("", text), object_pairs_hook=_mapping)
        if text.startswith("%YAML"):  # OpenCV's "%YAML:1.0" is no directive of YAML
            text = text.partition("\n")[2]
        return next(yaml.load_all(text, Loader=_TextLoader), None)
    except RecursionError:
        raise ValueError("nested too deeply") from None
    except (ET.ParseError, json.JSONDecodeError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        raise ValueError(f"not XML, JSON or YAML, or cut short: {reason}") from None


def _mapping(pairs: Iterable[tuple[Any, Any]]) -> dict[str, Any]:
    """Return the dictionary of keys and values; ValueError if a key has two values."""
    tree: dict[str, Any] = {}
    for key, value in pairs:
        if tree.setdefault(str(key), value) != value:
            raise ValueError(f"it has the key {plain(key)} twice")
    return tree


class _TextLoader(getattr(yaml, "CBaseLoader", yaml.BaseLoader)):  # type: ignore[misc]
    """A loader of YAML that ignores tags, and leaves scalars as they are written."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[str, Any]:
        """Return the dictionary of a node."""
        construct = self.construct_object
        return _mapping((construct(key, deep), construct(each, deep)) for key, each in node.value)


def _element(element: ET.Element) -> Any:
    children = list(element)
    if not children:
        return (element.text or "").strip().strip('"')
    if all(child.tag == "_" for child in children):
        return [_element(child) for child in children]
    return _mapping((child.tag, _element(child)) for child in children)


# --------------------------------------------------------------------------------------------------
# The error of a calibration: normal, with the covariance that the calibration states.

VIEW = ("fx_px", "fy_px", "cx_px", "cy_px")

#: Lens coefficients in OpenCV's order.
COEFFICIENTS = (
    "k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6", "s1", "s2", "s3", "s4", "tau_x", "tau_y",
)

#: Largest asymmetry, and largest rest of the factorisation, of a covariance that is accepted.
RTOL = 1e-6


@dataclass(frozen=True, slots=True)
class CalibrationError:
    """The error of n numbers: of fx, fy, cx, cy and, if the lens is uncertain, its coefficients.

    Attributes
    ----------
    names
        Of the numbers, (n,).
    factor
        (n, n) lower triangular L of the covariance matrix L Lᵀ.
    """

    names: tuple[str, ...]
    factor: Floats

    @staticmethod
    def of(sd: Sequence[float], covariance: Sequence[float], coefficients: int) -> CalibrationError:
        """Return the error that standard deviations or a covariance matrix state.

        Parameters
        ----------
        sd
            Standard deviations of 4 or 4 + ``coefficients`` numbers; empty if ``covariance`` is
            given.
        covariance
            Their covariance matrix, row by row.
        coefficients
            Number of lens coefficients.

        Raises
        ------
        ValueError
            Says what was expected.
        """
        n = len(sd) or math.isqrt(len(covariance))
        if n not in (4, 4 + coefficients):
            least = "4 numbers" if sd else "4 x 4 numbers"
            most = f"{4 + coefficients}" if sd else f"{4 + coefficients} x {4 + coefficients}"
            raise ValueError(
                f"{least}, of fx, fy, cx and cy" + (
                    f", or {most}, with the {coefficients} coefficients of distortion"
                    if coefficients else ": distortion is empty"
                )
            )
        names = (*VIEW, *COEFFICIENTS[: n - 4])
        if sd:
            if min(sd) < 0:
                raise ValueError("standard deviations of at least 0")
            return CalibrationError(names, np.diag(np.array(sd, dtype=np.float64)))
        matrix = np.reshape(np.array(covariance, dtype=np.float64), (n, n))
        deviations = np.sqrt(np.diagonal(matrix).clip(0))
        allowed = RTOL * np.outer(deviations, deviations)
        if not (np.abs(matrix - matrix.T) <= allowed).all():
            raise ValueError("a symmetric matrix")
        factor = _cholesky((matrix + matrix.T) / 2)
        if not (np.abs(factor @ factor.T - matrix) <= allowed).all():
            raise ValueError("a covariance: no variance below 0, no correlation beyond 1")
        return CalibrationError(names, factor)

    def sd(self, name: str) -> float:
        """Return the standard deviation of one of the numbers."""
        return math.sqrt(math.fsum((self.factor[self.names.index(name)] ** 2).tolist()))

    def believed(self, truth: Sequence[Floats], normals: Sequence[Floats]) -> list[Floats]:
        """Return the n numbers (N,) each that a calibration of true cameras gives.

        Parameters
        ----------
        truth
            The n true numbers, (N,) each.
        normals
            n standard normal numbers, (N,) each.
        """
        believed = []
        for k, row in enumerate(self.factor):
            source, scale = k, np.array(1.0)
            other = {0: 1, 1: 0}.get(k)
            if other is not None and not row.any() and self.factor[other].any():
                # A focal length without error beside one that has it: the aspect ratio was fixed.
                source, scale = other, truth[k] / truth[other]
            number = truth[k].copy()
            for factor, normal in zip(self.factor[source], normals, strict=True):
                if factor != 0:
                    number += scale * factor * normal
            believed.append(number)
        return believed


def _cholesky(matrix: Floats) -> Floats:
    """Return the lower triangular factor of a semidefinite matrix; columns without variance are 0.

    In plain arithmetic in a fixed order, so that draws are the same on every machine.
    """
    n = len(matrix)
    rows = matrix.tolist()
    factor = [[0.0] * n for _ in range(n)]
    for j in range(n):
        left = rows[j][j] - math.fsum(factor[j][k] ** 2 for k in range(j))
        if not left > 1e-13 * rows[j][j]:
            continue
        factor[j][j] = math.sqrt(left)
        for i in range(j + 1, n):
            rest = rows[i][j] - math.fsum(factor[i][k] * factor[j][k] for k in range(j))
            factor[i][j] = rest / factor[j][j]
    return np.array(factor)
