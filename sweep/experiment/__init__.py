"""The declared experiment: pipeline file, axes, validation, random streams, dataset template."""
