"""Under test: detectors, solvers, errors, bound, flags; without the grid of the experiment."""
