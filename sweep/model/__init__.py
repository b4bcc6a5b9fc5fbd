"""What is simulated: camera, marker, pose, renderers. Nothing here knows of detectors."""
