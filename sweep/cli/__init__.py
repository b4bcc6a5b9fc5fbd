"""The commands: they parse arguments, call the library and print what it returns.

Exit status: 0 done, 1 failed while running or damage found, 2 refused as asked for, 130 stopped by
Ctrl-C. Heavy packages are imported inside each command, so that ``sweep --help`` is quick.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Sequence

from sweep.cli.command import (
    SESSION,
    accept_any_text,
    answer,
    print_error,
    print_system_error,
    printing,
    quiet_matplotlib,
)
from sweep.cli.parser import build_parser
from sweep.errors import SweepError
from sweep.installation import check_installation


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command; return its exit status.

    Parameters
    ----------
    arguments
        The words after ``sweep`` on the command line; by default this process'.
    """
    accept_any_text()
    quiet_matplotlib()
    parser, _ = build_parser()
    SESSION.given = list(sys.argv[1:] if arguments is None else arguments)
    SESSION.flags, SESSION.stopped = {}, "stopped"
    try:
        options = parser.parse_args(arguments)
        if options.command is None:
            with printing():
                print(parser.format_help(), end="")
            return 0
        SESSION.flags, SESSION.form = options.flags, getattr(options, "printed", "text")
        check_installation()
        function = options.command.function
        found = function(**{name: getattr(options, name)
                            for name in inspect.signature(function).parameters})
        with printing():
            return answer(found)
    except SweepError as error:
        return print_error(error)
    except KeyboardInterrupt:
        print(SESSION.stopped, file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 1
    except (OSError, MemoryError, RuntimeError, ValueError) as error:
        return print_system_error(error)
    finally:
        if arguments is None and "logging" in sys.modules:
            # What the threads of other packages say while the process ends would stand below.
            sys.modules["logging"].disable()
