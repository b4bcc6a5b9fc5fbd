"""Make the gallery: ten pictures, each with its pipeline and the few statements that make it.

    python notebooks/gallery.py [FOLDER] [--only NAME ...]

The folder (default: runs/gallery) gets a PNG a picture, the pipelines and a page, README.md. Lines
that begin with ``sweep`` are commands, others Python, after `SETTING`. About five minutes on two
cores; the pictures of costs are those of the machine at hand.
"""

import argparse
import contextlib
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import NamedTuple

import matplotlib as mpl

mpl.use("agg")

SETTING = """\
import matplotlib.pyplot as plt, numpy as np, xarray as xr, sweep
from sweep.analysis import *
"""

STYLE = {
    "figure.dpi": 110, "figure.figsize": (7, 4.2), "figure.constrained_layout.use": True,
    "axes.spines.top": False, "axes.spines.right": False, "axes.grid": True, "grid.alpha": 0.3,
    "lines.marker": "o", "lines.markersize": 4, "legend.frameon": False,
}


UNDECIDED = 3
"""Exit status of a command whose answer needs more draws; the picture shows that."""


class Picture(NamedTuple):
    """A picture: what it shows, its pipeline and the statements that make NAME.png."""

    name: str
    shows: str
    pipeline: str
    lines: str
    others: tuple[tuple[str, str], ...] = ()
    """Other files, (name, content)."""


WEBCAM = """\
camera = { width_px = 1280, height_px = 720, hfov_deg = 70 }
marker = { dictionary = "DICT_4X4_50", size_m = 0.1 }
"""

DRAWN = "azimuth_deg = { uniform = [0, 360] }, roll_deg = { uniform = [0, 360] }, jitter_px = 0.5"

PICTURES = (
    Picture(
        "scene", "A marker through a wide lens, moving, in uneven light: the true outline, the "
        "detected corners and the axes of the estimated pose.",
        """\
camera = { width_px = 640, height_px = 480, fx_px = 420, distortion = [-0.25, 0.06, 0, 0, 0] }
marker = { size_m = 0.08 }
pose = { distance_m = 0.28, tilt_deg = 45, azimuth_deg = 30, frame_x = 0.35, frame_y = 0.4 }
[scene]
blur_px = 1.0
noise_grey = 5
illumination_gradient = 0.5
velocity_x_m_s = 0.8
exposure_s = 0.008
black = 30
white = 210
background = 120
[detector]
cornerRefinementMethod = "subpix"
[axes]
trial = 1
""",
        "sweep show scene.toml -o scene.png"),
    Picture(
        "bound", "Error against distance, beside the accuracy bound: the standard deviation of the "
        "distance that no unbiased method beats on these pixels.",
        f"""\
{WEBCAM}pose = {{ tilt_deg = 30, {DRAWN} }}
detector = {{ cornerRefinementMethod = "subpix" }}
estimator = {{ corner_noise_px = 0.3 }}
[scene]
noise_grey = 3
blur_px = 0.6
black = 40
white = 200
background = 120
bound = "known_blur"
[axes]
distance_m = {{ geom = [0.5, 4, 7] }}
solver = ["ippe_square", "photometric"]
trial = 60
""",
        """\
results = sweep.run("bound.toml", store="runs/bound.zarr").load()
lines = [1e3 * results.translation_error_m.sel(xyz="z", drop=True).std("trial"),
         1e3 * results.bound_std.sel(pose_parameter="translation_z", drop=True).median("trial")
         .assign_coords(solver="bound")]
xr.concat(lines, "solver", coords="minimal", compat="override").assign_attrs(
    long_name="standard deviation of z", units="mm").reset_coords(drop=True).plot.line(
    x="distance_m", yscale="log")
"""),
    Picture(
        "flips", "How often the pose is the mirror of the truth, by tilt and side: of 50 px only "
        "frontal markers, of 20 px at every tilt.",
        f"""\
{WEBCAM}pose = {{ {DRAWN} }}
scene = {{ noise_grey = 3, blur_px = 0.6 }}
detector = {{ cornerRefinementMethod = "subpix" }}
[axes]
side_px = [20, 30, 50]
tilt_deg = [0, 5, 10, 15, 20, 30, 40, 50, 60]
trial = 300
""",
        """\
results = sweep.run("flips.toml", store="runs/flips.zarr")
share = 100 * flip_rate(results, per=["side_px", "tilt_deg"]).flip_rate
share.assign_attrs(long_name="flipped, of the solved", units="%").plot.line(x="tilt_deg")
"""),
    Picture(
        "ambiguity", "A threshold on the ambiguity rejects right poses, too: what each threshold "
        "keeps of the flipped and of the other poses.",
        f"""\
{WEBCAM}pose = {{ side_px = {{ uniform = [20, 60] }}, tilt_deg = {{ uniform = [0, 60] }}, {DRAWN} }}
scene = {{ noise_grey = 3, blur_px = 0.6 }}
detector = {{ cornerRefinementMethod = "subpix" }}
[axes]
trial = 3000
""",
        """\
results = sweep.run("ambiguity.toml", store="runs/ambiguity.zarr")
table = 100 * ambiguity(results, thresholds=np.linspace(0.02, 1, 50)).isel(threshold=slice(50))
xr.concat([table.flips_kept_rate, 100 - table.right_rejected_rate],
          xr.Variable("poses", ["flipped", "right"])).assign_attrs(
    long_name="kept of these poses", units="%").plot.line(x="threshold", marker="", ylim=(0, 100))
"""),
    Picture(
        "limit", "How far 95 % are detected, by tilt, with the interval of the limit: trials run "
        "where they decide.",
        f"""\
{WEBCAM}pose = {{ {DRAWN} }}
scene = {{ noise_grey = 4, blur_px = 0.8 }}
[require]
all = ["detection >= 0.95"]
[axes]
distance_m = {{ geom = [1, 8, 13] }}
tilt_deg = [0, 20, 40, 60]
""",
        "sweep limit limit.toml --along distance_m --max-trials 300 -o limit.png"),
    Picture(
        "tradeoff", "What accuracy costs: milliseconds a frame against the rotation error, of each "
        "refinement and solver on the same images.",
        f"""\
{WEBCAM}pose = {{ side_px = 60, tilt_deg = 40, {DRAWN} }}
[scene]
noise_grey = 3
blur_px = 0.6
window = "full"
black = 40
white = 200
background = 120
[axes]
cornerRefinementMethod = ["none", "subpix", "contour"]
solver = ["ippe_square", "iterative", "photometric"]
trial = 150
""",
        "sweep tradeoff tradeoff.toml --seconds 20 -o tradeoff.png"),
    Picture(
        "boards", "One marker of 80 mm against a ChArUco and four markers on a sheet of the same "
        "area: the 95th percentile of the rotation error. A line ends where more than 5 % of the "
        "poses are not solved.",
        """\
camera = { width_px = 640, height_px = 480, fx_px = 600 }
marker = { dictionary = "DICT_5X5_100" }
board = { rows = 2, columns = 2, gap_m = 0.006, squares_x = 3, squares_y = 3, square_m = 0.032 }
pose = { tilt_deg = { uniform = [0, 60] }, azimuth_deg = { uniform = [0, 360] }, jitter_px = 20 }
scene = { blur_px = 0.6, noise_grey = 2, black = 40, white = 200, background = 120 }
detector = { cornerRefinementMethod = "subpix" }
estimator = { solver = "iterative" }
[axes]
target = { zip = { kind = ["none", "charuco", "grid"], size_m = [0.08, 0.024, 0.04] } }
distance_m = [0.3, 0.5, 0.7, 1, 1.4]
trial = 200
""",
        """\
results = sweep.run("boards.toml", store="runs/boards.zarr")
errors = error_statistics(results, per=["target", "distance_m"]).rotation_p95_deg
errors.where(np.isfinite(errors)).assign_coords(
    target=["marker", "ChArUco", "2 x 2 markers"]).plot.line(x="distance_m", yscale="log")
"""),
    Picture(
        "twins", "Photographs (here exported from a scene with sharpening and uneven light) beside "
        "a simulation of the same poses with blur and noise alone.",
        """\
seed = 7
camera = { width_px = 640, height_px = 480, fx_px = 600 }
marker = { dictionary = "DICT_4X4_50", size_m = 0.022 }
board = { kind = "charuco", squares_x = 7, squares_y = 5, square_m = 0.03 }
estimator = { solver = "iterative" }
[scene]
blur_px = 0.7
noise_grey = 3
sharpening = 0.6
sharpening_px = 1.5
illumination_gradient = 0.3
[pose]
distance_m = { uniform = [0.3, 0.5] }
tilt_deg = { uniform = [10, 45] }
azimuth_deg = { uniform = [0, 360] }
[axes]
trial = 12
""",
        """\
sweep export twins.toml shots
sweep photos shots/images --camera shots/cameras/camera-0.opencv.yml --board board.toml \\
    --set cornerRefinementMethod=subpix
sweep compare runs/images.zarr plain.toml -o twins.png
""",
        (("board.toml", """\
kind = "charuco"
dictionary = "DICT_4X4_50"
squares_x = 7
squares_y = 5
square_m = 0.03
marker_m = 0.022
"""), ("plain.toml", """\
[scene]
blur_px = 0.7
noise_grey = 3
"""))),
    Picture(
        "calibration", "Errors of the focal length in calibrations from 20 views each, and the "
        "deviation that OpenCV reports: tilted views determine it, and what OpenCV reports leaves "
        "out the bias of corners.",
        """\
camera = { width_px = 640, height_px = 480, fx_px = 600, fy_px = 600 }
marker = { dictionary = "DICT_5X5_100", size_m = 0.02 }
board = { kind = "charuco", squares_x = 7, squares_y = 5, square_m = 0.03 }
scene = { blur_px = 0.5, noise_grey = 2, black = 40, white = 200, background = 120 }
detector = { cornerRefinementMethod = "subpix" }
estimator = { solver = "iterative" }
[pose]
distance_m = { uniform = [0.3, 0.5] }
azimuth_deg = { uniform = [0, 360] }
roll_deg = { uniform = [-30, 30] }
[axes]
tilt_deg = [2, 5, 10, 20, 30, 40]
trial = 200
""",
        """\
results = sweep.run("calibration.toml", store="runs/calibration.zarr")
fx = calibration_summary(camera_calibrations(results, [20], coefficients=0)).sel(
    intrinsic="fx_px", views=20)
xr.concat([fx.rmse, fx.mean_std], xr.Variable("error", ["RMS", "told by OpenCV"])).assign_attrs(
    long_name="error of fx", units="px").reset_coords(drop=True).plot.line(
    x="tilt_deg", yscale="log")
"""),
    Picture(
        "outcomes", "Why poses are lost as the marker gets small: the share of each outcome.",
        f"""\
{WEBCAM}pose = {{ tilt_deg = {{ uniform = [0, 60] }}, {DRAWN} }}
scene = {{ noise_grey = 4, blur_px = 0.8 }}
[axes]
side_px = [8, 10, 12, 14, 17, 20, 24, 29]
trial = 400
""",
        """\
results = sweep.run("outcomes.toml", store="runs/outcomes.zarr")
shares = 100 * failure_composition(results, per=["side_px"]).share.to_pandas()
shares.loc[:, shares.max() > 0].plot.bar(
    stacked=True, width=0.9, rot=0, xlabel="side [px]", ylabel="share of the poses [%]").legend(
    loc="center left", bbox_to_anchor=(1, 0.5))
"""),
)


def make(picture: Picture) -> None:
    """Write a picture and its files into the working folder."""
    for name, content in ((f"{picture.name}.toml", picture.pipeline), *picture.others):
        Path(name).write_text(content)
    if picture.lines.startswith("sweep "):
        for line in picture.lines.replace("\\\n", "").splitlines():
            command = [sys.executable, "-m", *line.split()]
            status = subprocess.run(  # noqa: S603
                command, check=False, stdout=subprocess.DEVNULL).returncode
            if status not in {0, UNDECIDED}:
                raise SystemExit(f"{line}: exit status {status}")
        return
    import matplotlib.pyplot as plt  # noqa: PLC0415

    with plt.rc_context(STYLE):
        exec(SETTING + picture.lines, {})  # noqa: S102  (the lines that the page shows)
        plt.savefig(f"{picture.name}.png")
        plt.close("all")


def page() -> str:
    """Return the gallery's page."""
    made = "# Gallery\n\nMade by `python notebooks/gallery.py`. Python begins with"
    parts = [f"{made}\n\n```python\n{SETTING}```\n"]
    for each in PICTURES:
        language = "sh" if each.lines.startswith("sweep ") else "python"
        files = "".join(f"\n`{name}`:\n\n```toml\n{content}```\n" for name, content in each.others)
        parts.append(
            f"## {each.name}\n\n{each.shows}\n\n![{each.name}]({each.name}.png)\n\n"
            f"```{language}\n{each.lines.strip()}\n```\n\n`{each.name}.toml`:\n\n"
            f"```toml\n{each.pipeline}```\n{files}")
    return "\n".join(parts)


def main() -> None:
    """Make all pictures, or those that are named, and the page."""
    parser = argparse.ArgumentParser(description="Make the gallery.")
    parser.add_argument("folder", nargs="?", default="runs/gallery", type=Path)
    parser.add_argument("--only", nargs="*", default=[each.name for each in PICTURES])
    options = parser.parse_args()
    options.folder.mkdir(parents=True, exist_ok=True)
    with contextlib.chdir(options.folder):
        for each in PICTURES:
            if each.name in options.only:
                start = time.monotonic()
                make(each)
                print(f"{os.fspath(options.folder / each.name)}.png: "
                      f"{time.monotonic() - start:.0f} s", flush=True)
        Path("README.md").write_text(page())


if __name__ == "__main__":
    main()
