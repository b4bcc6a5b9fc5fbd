"""Print render-tag's median position error, an effect more in each row.

python pipelines/published/waterfall.py
"""

import runpy
from pathlib import Path

make = runpy.run_path(str(Path(__file__).parent / "make.py"))
pipeline = make["entries"]()["render_tag"]["pipeline"]
angles = pipeline["axes"]["view_angle_deg"]
sharp = {"black": 20, "white": 220, "background": 128}
ROWS = [
    ("160 mm, tilt uniform in 0-60°", 0.16, None, sharp),
    ("128 mm", 0.128, None, sharp),
    ("their angle to the line of sight", 0.128, angles, sharp),
    ("blur 0.2 px", 0.128, angles, {**sharp, "blur_px": 0.2}),
    ("exponent 1 / 2.2, linear levels 2 and 200", 0.128, angles,
     {"black": 2, "white": 200, "background": 60, "blur_px": 0.2, "tone_gamma": 0.4545}),
]
for name, size, views, scene in ROWS:
    uniform = [6.0 * k + 3 for k in range(10)]
    content = {**pipeline, "scene": scene, "axes": {"trial": 10}}
    content["axes"] = {("view_angle_deg" if views else "tilt_deg"): views or uniform, "trial": 10}
    results = make["results_of"](content, quick=False, marker={"size_m": size})
    print(f"| {name} | {make['median_position_mm'](results):.2f} |", flush=True)
