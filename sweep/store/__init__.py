"""The Zarr store: layout, life cycle, blocks, receipts, checksums, lock and provenance."""
