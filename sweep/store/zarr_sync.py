"""What Zarr has no public name for: running its coroutines to their end from ordinary code."""

from __future__ import annotations

from zarr.core.sync import sync

__all__ = ["sync"]
