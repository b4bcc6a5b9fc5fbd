"""How many views, how near, how tilted: three statements of mrcal's tour, on rendered ChArUcos.

The tour (mrcal.secretsauce.net/tour-choreography.html) simulates corners with independent errors of
2 px. Here the corners are those that OpenCV finds in rendered images, with their own errors, and
bias. Each number is the root mean square over sets of views that have no view in common: the error
of the focal length, and of the depth of a target at 3 m; intervals are those of a chi-square
distribution, so they hold for errors that are normal about 0.

Usage: views.py [TRIALS]   (default: 2000 views for the number of views, a fifth for the others)
"""

import sys
import tempfile

import numpy as np
from scipy.stats import chi2

import sweep
from sweep.analysis import camera_calibrations

VIEWS, OTHERS = (10, 25, 50, 100, 200), 20
TILTED = "tilt_deg={uniform=[0, 45]}"
QUESTIONS = {
    "views": [TILTED],
    "distance_m": [TILTED, "distance_m=[0.25, 0.5, 1.0, 2.0]"],
    "tilt_deg": ["tilt_deg=[5, 15, 30, 45, 60, 70]"],
}


def interval(errors):
    """Return the root mean square of errors and the ends of its 95 % interval."""
    errors = errors[np.isfinite(errors)]
    if not len(errors):
        return "no calibration"
    root = np.sqrt((errors**2).mean())
    low, high = (root * np.sqrt(len(errors) / chi2.ppf(share, len(errors)))
                 for share in (0.975, 0.025))
    return f"{root:.3g} ({low:.3g} to {high:.3g})"


def table(question, settings, trials):
    """Print the errors of a question's calibrations."""
    pipeline = sweep.Pipeline.from_toml(
        "pipelines/calibration.toml", [*settings, "curvature_per_m=0", f"trial={trials}"])
    with tempfile.TemporaryDirectory() as folder:
        sweep.run(pipeline, store=f"{folder}/views.zarr")
        results = sweep.open(f"{folder}/views.zarr").load()
        print(f"\n| {question} | sets | fx, px | depth at 3 m, mm |\n| --- | --- | --- | --- |")
        if question == "views":
            rows = [(count, camera_calibrations(results, [count], coefficients=2))
                    for count in VIEWS if count <= trials]
        else:
            found = camera_calibrations(results, [OTHERS], coefficients=2)
            rows = [(value.item(), found.sel({question: value})) for value in found[question]]
    for value, found in rows:
        fx = found.intrinsic_error.sel(intrinsic="fx_px").values.ravel()
        depth = 1000 * found.position_error_m.isel(direction=0, xyz=2).values.ravel()
        print(f"| {value:g} | {np.isfinite(fx).sum()} of {len(fx)} | {interval(fx)} | "
              f"{interval(depth)} |", flush=True)


def main(arguments):
    trials = int(arguments[0]) if arguments else 2000
    for question, settings in QUESTIONS.items():
        table(question, settings, trials if question == "views" else max(trials // 5, OTHERS))


if __name__ == "__main__":
    main(sys.argv[1:])
