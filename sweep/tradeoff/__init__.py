"""Accuracy against cost: paired timing, measurement and the Pareto front."""
