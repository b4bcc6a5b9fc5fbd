"""The simulation: camera, lens, marker, pose, renderers, effects, sensor; without detectors."""
