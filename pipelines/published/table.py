"""The tables of this folder's page, from the stores of its pipelines.

python pipelines/published/table.py runs
"""

import sys
from pathlib import Path

import numpy as np

import sweep
from sweep.measure.flags import DetectionStatus, EstimateStatus

FMAC = {"none": (5.4, 3.8, 14.7)}
RENDER_TAG = {
    (1080, "opencv", "subpix"): (3.5, 66.6, 0.127, 0.569),
    (1080, "opencv", "apriltag"): (3.0, 55.3, 0.067, 0.376),
    (1080, "pupil-apriltags", "none"): (2.9, 54.4, 0.061, 65.365),
    (1080, "locus-tag", "none"): (0.4, 20.1, 0.041, 0.249),
    (2160, "opencv", "subpix"): (6.5, 133.8, 0.104, 0.489),
    (2160, "opencv", "apriltag"): (5.8, 107.5, 0.072, 0.449),
    (2160, "pupil-apriltags", "none"): (5.7, 101.3, 0.072, 65.716),
    (2160, "locus-tag", "none"): (0.8, 37.0, 0.041, 0.267),
}
"""Published: median and 99th percentile of the position error in mm, and of the rotation in °."""

ROBOCEPTION = {"DICT_APRILTAG_36h11": 1.1, "DICT_APRILTAG_16h5": 1.4}


def row(*cells):
    print("| " + " | ".join(cells) + " |")


def apriltag_334(results):
    for name in results.detector.values:
        for decimate in results.quad_decimate.values:
            corner = results.corner_error_px.sel(
                detector=name, quad_decimate=decimate, corner="top_left")
            for side in results.side_px.values:
                x, y = 10 + corner.sel(side_px=side).values.astype(float)
                row(name, f"{decimate:g}", f"{side:g}", "9.875, 9.875", f"{x:.3f}, {y:.3f}",
                    f"{x / 9.875:.4f}, {y / 9.875:.4f}")


def fmac(results):
    for dictionary in results.dictionary.values:
        for method in results.cornerRefinementMethod.values:
            part = results.sel(dictionary=dictionary, cornerRefinementMethod=method)
            solved = (part.estimate == EstimateStatus.solved).values
            errors = 1e3 * part.translation_error_m.values[solved].astype(float)
            sd, mean = errors.std(axis=0), errors.mean(axis=0)
            theirs = FMAC["none"] if dictionary == "DICT_6X6_250" else None
            row(dictionary, method, *(
                [" / ".join(f"{each:g}" for each in theirs)] if theirs else ["not found"]),
                " / ".join(f"{each:.1f}" for each in sd),
                " / ".join(f"{a / b:.2f}" for a, b in zip(sd, theirs, strict=True))
                if theirs else "", f"{mean[2]:+.1f}",
                f"{float((part.detection == DetectionStatus.detected).mean()):.2%}")


def render_tag(results):
    for k, height in enumerate(results.height_px.values.tolist()):
        for j in range(results.sizes["method"]):
            part = results.isel(frame=k, method=j)
            position = 1e3 * np.linalg.norm(
                part.translation_error_m.transpose("trial", "xyz").values, axis=1)
            ours = [*np.nanpercentile(position, [50, 99]),
                    *np.nanpercentile(part.rotation_error_deg.values, [50, 99])]
            name = str(part.detector.values), str(part.cornerRefinementMethod.values)
            theirs = RENDER_TAG[(height, *name)]
            recall = float((part.detection == DetectionStatus.detected).mean())
            row(str(height), " ".join(each for each in name if each != "none"), f"{recall:.0%}",
                *(f"{a:g} / {b:.3g} / {b / a:.2f}" for a, b in zip(theirs, ours, strict=True)))


def roboception_range(results):
    rates = (results.detection == DetectionStatus.detected).mean(["marker_id", "trial"])
    for dictionary, theirs in ROBOCEPTION.items():
        often = rates.sel(dictionary=dictionary).values >= 0.95
        ours = float(results.distance_m.values[often].max())
        row(dictionary, f"{theirs:g} m", f"{ours:g} m", f"{ours / theirs:.2f}")


if __name__ == "__main__":
    for table in (apriltag_334, fmac, render_tag, roboception_range):
        store = Path(sys.argv[1]) / f"{table.__name__}.zarr"
        if store.exists():
            print(f"\n{table.__name__}")
            table(sweep.open(store))
