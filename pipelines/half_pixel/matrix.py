"""Which detectors agree with which convention of the camera, by the check of plug-ins.

Each detector is tried on 32 scenes rendered with pixel centres at 0, and its mean offset measured.
What an adapter subtracts by its declaration is added again, so that each line has the numbers that
the program itself returns: offset 0 belongs to cameras (and renderers) with pixel centres at 0, as
OpenCV's and ROS' calibrations have them, offset 0.5 to those with the first pixel's corner at 0.

Usage: matrix.py [ADAPTER ...], such as pyapriltags
"""

import sys

from sweep.conformance.check import check_plugin
from sweep.plugins.loading import load

DETECTORS = [("opencv", f'cornerRefinementMethod="{each}"') for each in
             ("none", "subpix", "contour", "apriltag")]
DETECTORS += [(name, "") for name in sys.argv[1:]]

print("| detector | mean offset, px | beside centres at 0 | beside centres at 0.5 |")
print("| --- | --- | --- | --- |")
for name, setting in DETECTORS:
    offset = check_plugin(name, settings=[setting] if setting else []).attrs["offset_px"]
    declared = 0.0 if name == "opencv" else getattr(
        load("detector", name, ".")[0], "pixel_center", 0.0)
    x, y = (each + declared for each in offset)
    off = [max(abs(x - centre), abs(y - centre)) for centre in (0, 0.5)]
    verdict = ["consistent" if each < 0.02 else f"off by {each:.2f} px" for each in off]
    what = setting.partition("=")[2].strip('"')
    print(f"| {name} {what} | {x:+.3f}, {y:+.3f} | {' | '.join(verdict)} |")
