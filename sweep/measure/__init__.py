"""What is under test: detectors, solvers, error metrics. Nothing here knows of the grid."""
