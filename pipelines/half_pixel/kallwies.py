"""Edge-refined AprilTag corners, as printed in a thread, before and after half a pixel is added.

https://github.com/UniBwTAS/apriltags_tas/issues/4, detections 0 and 1: "pt refined" and "true pt".
The true points come from a renderer that puts the first pixel's corner at (0, 0).
"""

import numpy as np

REFINED = np.array([
    [666.209, 405.139], [863.059, 345.799], [769.296, 236.059], [580.972, 287.414],
    [1730.35, 337.659], [1614.67, 232.706], [1477.36, 254.068], [1589.78, 364.345]])
TRUE = np.array([
    [666.74, 405.696], [863.697, 346.321], [769.869, 236.499], [581.434, 287.878],
    [1730.99, 338.155], [1615.25, 233.159], [1477.83, 254.572], [1590.29, 364.893]])

x, y = (REFINED - TRUE).mean(axis=0)
print(f"mean offset of eight corners: ({x:+.3f}, {y:+.3f}) px")
for name, shift in (("as printed", 0.0), ("half a pixel added", 0.5)):
    error = np.linalg.norm(REFINED + shift - TRUE, axis=1)
    print(f"{name}: median error {np.median(error):.3f} px, largest {error.max():.3f} px")
