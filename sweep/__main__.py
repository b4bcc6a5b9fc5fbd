"""``python -m sweep``: the commands."""

from sweep.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
