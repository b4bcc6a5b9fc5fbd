"""Photographs measured as simulated images are: their files, their truth, their store."""
