"""Which trials are needed: trials come in waves, and each wave is decided by those before."""
