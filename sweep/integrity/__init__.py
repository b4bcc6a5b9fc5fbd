"""Verification, repair and reproduction of stores."""
