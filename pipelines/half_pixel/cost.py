"""Half a pixel by focal length and depth: sideways 0.5 z / f, in direction atan(0.5 / f).

The closed form beside `cv2.solvePnP` on exact corners with a principal point that is off by half
a pixel in x, of a marker of 20 px at least, tilted by 40 degrees.
"""

import cv2
import numpy as np

print("| f, px | z, m | sideways, mm | solvePnP, mm | direction, deg | rotation by solvePnP, deg |")
print("| --- | --- | --- | --- | --- | --- |")
for f in (300.0, 600.0, 1200.0):
    for z in (0.3, 1.0, 3.0, 10.0):
        side = 100 * z / f
        points = side * np.array([[-.5, .5, 0], [.5, .5, 0], [.5, -.5, 0], [-.5, -.5, 0]])
        rotation = cv2.Rodrigues(np.radians([[180 - 40.0], [0.0], [0.0]]))[0]
        true, _ = cv2.Rodrigues(rotation)
        camera = np.array([[f, 0, 319.5], [0, f, 239.5], [0, 0, 1]])
        seen, _ = cv2.projectPoints(points, true, np.array([0.0, 0, z]), camera, None)
        camera[0, 2] += 0.5
        _, turn, place = cv2.solvePnP(points, seen, camera, None, flags=cv2.SOLVEPNP_ITERATIVE)
        off = np.degrees(np.linalg.norm(cv2.Rodrigues(cv2.Rodrigues(turn)[0] @ rotation.T)[0]))
        print(f"| {f:g} | {z:g} | {500 * z / f:.2f} | {1000 * abs(place[0, 0]):.2f} | "
              f"{np.degrees(np.arctan(0.5 / f)):.3f} | {off:.3f} |")
