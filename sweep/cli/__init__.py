"""The commands: they parse arguments, call the library and print what it returns.

Exit status: 0 done, 1 failed while running or damage found, 2 refused as asked for, 130 stopped by
Ctrl-C. Heavy packages are imported inside each command, so that ``sweep --help`` is quick.
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return its exit status.

    Parameters
    ----------
    arguments
        What follows ``sweep`` on the command line; by default that of this process.
    """
    from sweep.cli.errors import (  # noqa: PLC0415
        print_error,
        print_import_error,
        print_system_error,
    )
    from sweep.cli.output import accept_any_text, flushed  # noqa: PLC0415
    from sweep.cli.parser import build_parser, parse  # noqa: PLC0415
    from sweep.errors import SweepError  # noqa: PLC0415
    from sweep.installation import check_installation  # noqa: PLC0415

    accept_any_text()
    parser = build_parser()
    options = argparse.Namespace()
    try:
        options = parse(parser, arguments)
        options.given = list(sys.argv[1:] if arguments is None else arguments)
        if options.command is None:
            print(parser.format_help(), end="")
            return flushed(0)
        check_installation()
        return flushed(options.command.execute(options))
    except SweepError as error:
        return print_error(error, options)
    except ImportError as error:
        return print_import_error(error)
    except KeyboardInterrupt:
        print(getattr(options, "stopped", "stopped"), file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 1
    except (OSError, MemoryError, RuntimeError) as error:
        return print_system_error(error)
