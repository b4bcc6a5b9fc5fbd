"""Read a file of `sweep error-model` without packages: copy this file, or translate it."""

import json
import math
import sys
from bisect import bisect_right


def cell(table, boundaries, u):
    for ends, value in zip(boundaries, u, strict=False):
        table = table[bisect_right(ends, value)]
    return table

def interpolated(table, knots, u):
    if not knots:
        return table
    values = [interpolated(part, knots[1:], u[1:]) for part in table]
    if len(values) == 1:
        return values[0]
    k = min(max(bisect_right(knots[0], u[0]), 1), len(values) - 1)
    share = (u[0] - knots[0][k - 1]) / (knots[0][k] - knots[0][k - 1])
    return values[k - 1] + share * (values[k] - values[k - 1])

def pose_errors(model, x, y, z, viewing_angle_deg, side_px=None):
    """Return {error: {"sigma", "bias", "use"}} in the sight frame; NaN where nothing was seen."""
    if side_px is None:
        side_px = (model["side_px_times_distance_m"] or math.nan) / (z or math.nan)
    u = [math.log(value) if value > 0 else math.nan for value in (z, side_px)]
    u += [viewing_angle_deg, math.degrees(math.atan2(math.hypot(x, y), z))]
    seen = cell(model["looked_for"], model["cells_u"], u) and all(
        each["low"]
        <= sum(w * value for w, value in zip(each["weights"], u, strict=False))
        <= each["high"]
        for each in model["region"])
    return {name: {
        "sigma": math.exp(
            interpolated(each["ln_sigma"], model["knots_u"], u)) if seen else math.nan,
        "bias": interpolated(each["bias_u"], model["knots_u"], u) * (
            z if each["unit"] == "m" else 1.0) if seen else math.nan,
        "use": cell(each["use"], model["cells_u"], u) if seen else "no_poses",
    } for name, each in model["quantities"].items()}


if __name__ == "__main__":  # python pose_errors.py tag.json X Y Z VIEWING_ANGLE_DEG
    with open(sys.argv[1], encoding="utf-8") as file:
        first = json.load(file)["models"][0]
    for error, found in pose_errors(first, *map(float, sys.argv[2:6])).items():
        print(error, found)
