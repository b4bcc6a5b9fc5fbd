"""The README of an export: what is in the folder, its conventions, and how answers come back."""

from __future__ import annotations

from sweep.exchange.truth import TruthTables
from sweep.plan.experiment import Pipeline

_TEXT = """# {title}

{images:,} images of a marker with a known pose, {what}. Written by `sweep export`.
{invisible}
| file | holds |
| --- | --- |
| `images/NAME.png` | 8-bit grey images |
| `images.sha256` | their digests: `sha256sum -c images.sha256` |
| `truth.csv` | one row an image: marker, corners, pose, camera, and what varies |
| `truth_coco.json` | the same as COCO keypoints |
| `truth.nc` | the same as netCDF, over the experiment's axes: `xarray.open_dataset` |
| `cameras/*.opencv.yml`, `*.ros.yaml` | cameras for `cv::FileStorage` and ROS `camera_info` |
| `experiment/pipeline.toml` | the experiment; with the files that it names |

## Conventions

- Pixels: (0, 0) is the *centre* of the top left pixel, as in OpenCV and ROS. The image spans -0.5 \
to width - 0.5.
- Corners: of the black square, in the order top left, top right, bottom right, bottom left of the \
marker as OpenCV's dictionary draws it (`cv2.aruco.generateImageMarker`): `x0, y0` to `x3, y3`.
- Marker frame: origin at the centre; x right, y up, z out of the marker towards the viewer. \
`size_m` is the side of the black square.
- Camera frame: x right, y down, z forward, in metres.
- Pose: marker to camera. `rx, ry, rz` is the rotation vector in radians (`cv2.Rodrigues`), \
`tx, ty, tz` the position of the marker's centre in metres.
- {origin}

## Answers

Write one row for each marker that your program finds into a CSV file, and score it:

```csv
image,id,x0,y0,x1,y1,x2,y2,x3,y3
```

Poses are columns `rx,ry,rz,tx,ty,tz` or `qw,qx,qy,qz,tx,ty,tz`, beside the corners or instead of \
them. Print 17 digits, so that nothing is rounded. An image without a row counts as searched in \
vain; a candidate that was not decoded has the ID -1. JSON Lines do as well: \
`{{"image": "NAME.png", "id": 3, "corners": [[x, y], ...]}}` with `rvec` and `tvec`, or \
`quaternion` (w, x, y, z).

A program that needs nothing but OpenCV:

```python
{script}```

```sh
sweep score {folder} detections.csv --name mine
```

Where pixels, corners or frames differ, say so: `--pixel-center 0.5` if (0, 0) is the corner of \
the top left pixel; `--corner-order "TR TL BL BR"`; `--frame "right down in"` for the directions \
of the marker's x, y and z.
"""

_SCRIPT = """import csv
import cv2
detectors = {}
with open("truth.csv") as images, open("detections.csv", "w", newline="") as file:
    rows = csv.writer(file)
    rows.writerow(["image", "id"] + [f"{axis}{k}" for k in range(4) for axis in "xy"])
    for image in csv.DictReader(images):
        name = image["dictionary"]
        if name not in detectors:
            dictionary = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, name))
            detectors[name] = cv2.aruco.ArucoDetector(dictionary, cv2.aruco.DetectorParameters())
        grey = cv2.imread(f"images/{image['image']}", cv2.IMREAD_GRAYSCALE)
        corners, ids, rejected = detectors[name].detectMarkers(grey)
        ids = [-1] * len(rejected) if ids is None else [*ids.ravel(), *[-1] * len(rejected)]
        for quad, marker_id in zip([*corners, *rejected], ids):
            rows.writerow([image["image"], int(marker_id), *map(float, quad.ravel())])
"""


def guide(pipeline: Pipeline, tables: TruthTables, windowed: bool) -> str:
    """Return the README of an export."""
    invisible = ""
    if tables.invisible:
        invisible = (
            f"\n{tables.invisible:,} scenes more have no image: the marker is outside the frame "
            "or seen from behind, or the lens model does not hold there.\n"
        )
    origin = (
        "Images are windows: `origin_x_px, origin_y_px` is the first pixel of an image in the "
        "frame, and `cx_px, cy_px` the principal point *in the image*. Corners are those of the "
        "image. The camera files are of the frame: subtract the origin from their principal point."
        if windowed else
        "Images are whole frames: the camera files hold for every image that names them."
    )
    return _TEXT.format(
        title=pipeline.heading, images=tables.images,
        what="the marker's surroundings" if windowed else "whole frames", invisible=invisible,
        origin=origin, folder="FOLDER", script=_SCRIPT,
    )
