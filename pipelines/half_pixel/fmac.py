"""FMAC: AprilTag's corners have pixel centres at 0.5, the camera's principal point has them at 0.

Its box (arXiv:2601.07723v1, p. 13): 640 x 480, f = 822.317 px, 0.5 to 1.5 m, a mean error of
0.62 mm in x and in y with AprilTag 3.4.5. Corners that are half a pixel too large beside a
principal point that is right are right corners beside one that is half a pixel too small.
"""

import tempfile

import sweep
from sweep.analysis import error_statistics

MEASURED_MM = 0.62
F_PX, MEAN_Z_M = 822.317, 1.0

pipeline = sweep.Pipeline.from_toml("pipelines/published/fmac.toml", [
    'dictionary="DICT_APRILTAG_36h11"', 'cornerRefinementMethod="subpix"', "trial=4096",
    "convention={zip={believed_cx_px=[319.5, 319.0], believed_cy_px=[239.5, 239.0]}}",
])
with tempfile.TemporaryDirectory() as folder:
    sweep.run(pipeline, store=f"{folder}/fmac.zarr")
    results = sweep.open(f"{folder}/fmac.zarr")
    found = error_statistics(results, per="convention", quantities=["x", "y"]).compute()
predicted = 1000 * 0.5 * MEAN_Z_M / F_PX
print(f"half a pixel at {MEAN_Z_M:g} m: {predicted:.3f} mm; FMAC's mean error: {MEASURED_MM} mm, "
      f"{100 * (predicted / MEASURED_MM - 1):+.1f} %")
for index, name in enumerate(("centres at 0 in both", "corners with centres at 0.5")):
    row = found.isel(convention=index)
    said = [f"{axis} {1000 * row[f'{axis}_bias_m'].item():+.3f} "
            f"({1000 * row[f'{axis}_bias_m_low'].item():+.3f} to "
            f"{1000 * row[f'{axis}_bias_m_high'].item():+.3f}) mm" for axis in "xy"]
    print(f"{name}: mean error {', '.join(said)}")
x, y = (1000 * float(found[f"{axis}_bias_m"].diff("convention").item()) for axis in "xy")
print(f"the half pixel alone, on the same images: x {x:+.3f}, y {y:+.3f} mm")
