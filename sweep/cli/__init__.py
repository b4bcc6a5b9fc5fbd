"""The commands: they parse arguments, call the library and print what it returns.

Exit status: 0 done, 1 failed while running or damage found, 2 refused as asked for, 130 stopped by
Ctrl-C. Heavy packages are imported inside each command, so that ``sweep --help`` is quick.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return its exit status.

    Parameters
    ----------
    arguments
        What follows ``sweep`` on the command line; by default that of this process.
    """
    from sweep.cli.errors import print_error, print_import_error  # noqa: PLC0415
    from sweep.cli.installation import check_installation  # noqa: PLC0415
    from sweep.cli.parser import build_parser  # noqa: PLC0415
    from sweep.errors import SweepError  # noqa: PLC0415

    parser = build_parser()
    options = parser.parse_args(arguments)
    if options.command is None:
        parser.print_help()
        return 0
    try:
        check_installation()
        return int(options.command.execute(options))
    except SweepError as error:
        return print_error(error, options)
    except ImportError as error:
        return print_import_error(error)
    except KeyboardInterrupt:
        without = " without --overwrite" if getattr(options, "overwrite", False) else ""
        print(f"stopped; the same command{without} continues", file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 1
