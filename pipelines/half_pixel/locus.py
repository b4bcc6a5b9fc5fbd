"""A harness that gives OpenCV's corners (pixel centres at 0) a principal point of W / 2, H / 2.

Locus' benchmark does (its tools/bench/utils.py): the middle of the frame is at (W - 1) / 2 where
the first pixel's centre is (0, 0), so that every detector with OpenCV's convention is charged with
half a pixel, and every detector with centres at 0.5 with nothing.
"""

import tempfile

import sweep
from sweep.analysis import error_statistics

pipeline = sweep.Pipeline.from_toml("pipelines/published/fmac.toml", [
    'dictionary="DICT_APRILTAG_36h11"', 'cornerRefinementMethod="subpix"', "trial=4096",
    "convention={zip={believed_cx_px=[319.5, 320.0], believed_cy_px=[239.5, 240.0]}}",
])
with tempfile.TemporaryDirectory() as folder:
    sweep.run(pipeline, store=f"{folder}/locus.zarr")
    results = sweep.open(f"{folder}/locus.zarr")
    errors = error_statistics(results, per="convention").compute()
    lateral = error_statistics(results, per="convention", quantities=["x", "y"]).compute()
for index, name in enumerate(("(W - 1) / 2, (H - 1) / 2", "W / 2, H / 2")):
    row, sides = errors.isel(convention=index), lateral.isel(convention=index)
    print(f"principal point at {name}: mean error x {1000 * sides.x_bias_m.item():+.3f} mm, "
          f"y {1000 * sides.y_bias_m.item():+.3f} mm; median position error "
          f"{1000 * row.position_median_m.item():.2f} mm, rotation "
          f"{row.rotation_median_deg.item():.3f} deg")
