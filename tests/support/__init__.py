"""Helpers that several test modules share; nothing of tests/ is imported by another test."""
