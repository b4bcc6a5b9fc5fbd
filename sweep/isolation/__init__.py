"""Child processes, time limits, crash isolation and interrupts."""
