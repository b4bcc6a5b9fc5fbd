"""Documents of pipelines with a pose in any way, at any value."""

import numpy as np

from sweep.experiment.parameters import CHOICES, IN_CAMERA, PARAMETERS, WORLD

LENS = [-0.3, 0.1, 0.001, -0.002]
LENSES = [[], LENS, [0.3, 0.2, 0, 0], [-1.2, 0.3, 0, 0], [5, 0, 0, 0],
          [-0.4, 0.2, 0, 0, 0, 0, 0, 0, 0.01, 0, 0.01, 0, 0.1, -0.1]]


def any_value(rng, name):
    declared = PARAMETERS[name]
    low, high = max(declared.low, -1e12), min(declared.high, 1e12)
    ends = [1e-9 if declared.open_low else low, high, max(low, 1e-3)]
    usual = [1e-9, 0.001, 1, 89.9999999, 90, 180]
    number = [rng.choice(ends), rng.choice(usual), rng.uniform(low, min(high, 1000))]
    return float(np.clip(number[rng.integers(3)], low, high))


def any_document(rng):
    """Return a document with a pose given in any way, at any value, fixed, as axis or drawn."""
    if rng.random() < 0.25:
        names = [str(name) for name in rng.choice(WORLD, rng.integers(1, 12), replace=False)]
    else:
        chosen = [ways[rng.integers(len(ways))] for ways in CHOICES
                  if {*ways[0]} <= {*IN_CAMERA}]
        turned = {"yaw_deg", "pitch_deg"} & {name for way in chosen for name in way}
        without = ("tilt_deg", "view_angle_deg", "azimuth_deg") if turned else ()
        given = dict.fromkeys(name for way in chosen for name in way)
        names = [name for name in given if name not in without] + ["roll_deg"]
    pose, axes = {name: any_value(rng, name) for name in names}, {}
    if rng.random() < 0.5:
        pose["jitter_px"] = float(rng.choice([0.5, 50]))
    for name in names:
        kind, other = rng.random(), any_value(rng, name)
        if kind < 0.3 and other != pose[name]:
            axes[name] = [pose.pop(name), other]
        elif kind < 0.5 and other > pose[name]:
            pose[name] = {"uniform": [pose[name], other]}
    if "jitter_px" in pose or any(isinstance(value, dict) for value in pose.values()):
        axes["trial"] = 3
    return {
        "pose": pose, "axes": axes,
        "marker": {"size_m": float(rng.choice([0.05, 1e-9, 1e9])),
                   "quiet_zone_modules": float(rng.choice([0, 1, 100]))},
        "camera": {"fx_px": float(rng.choice([300, 600, 1e-3, 1e9])),
                   "width_px": int(rng.choice([640, 1, 100_000])),
                   "distortion": LENSES[rng.integers(len(LENSES))]},
    }
