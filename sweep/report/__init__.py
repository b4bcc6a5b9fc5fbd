"""Figures and drawn scenes. Nothing here knows how results are made."""
