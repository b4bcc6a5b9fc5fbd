"""The commands: they parse arguments, call the library and print what it returns.

Exit status: 0 done, 1 failed while running or damage found, 2 refused as asked for, 130 stopped by
Ctrl-C. Heavy packages are imported inside each command, so that ``sweep --help`` is quick.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Sequence

from sweep.cli import command
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
    command.hold_streams()
    command.accept_any_text()
    command.quiet_matplotlib()
    (parser, _), session = build_parser(), command.SESSION
    session.given = list(sys.argv[1:] if arguments is None else arguments)
    session.flags, session.stopped = {}, "stopped"
    try:
        options = parser.parse_args(arguments)
        if options.command is None:
            with command.printing():
                print(parser.format_help(), end="")
            return 0
        session.flags, session.form = options.flags, getattr(options, "printed", "text")
        check_installation()
        function = options.command.function
        found = function(**{name: getattr(options, name)
                            for name in inspect.signature(function).parameters})
        with command.printing():
            return command.answer(found)
    except SweepError as error:
        return command.print_error(error)
    except KeyboardInterrupt:
        print(session.stopped, file=sys.stderr)
        return 130
    except BrokenPipeError:
        sys.stderr.close()
        return 1
    except (OSError, MemoryError, RuntimeError) as error:
        return command.print_system_error(error)
    finally:
        if arguments is None and "logging" in sys.modules:
            # What the threads of other packages say while the process ends would stand below.
            sys.modules["logging"].disable()
