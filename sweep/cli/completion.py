"""``sweep completion``: scripts by which shells complete commands, options, files and names.

They are made from the parser, once: nothing of Python runs while a user types.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from sweep.cli.command import Command, Example

NAMES, AXES, FILES, NOTHING = "names", "axes", "files", "nothing"
"""What follows an option: names of parameters with "=" or without, a file, or nothing known."""

AXIS_METAVARS = ("AXIS", "AXES")

FILE_METAVARS = ("STORE", "PNG", "FILE", "FIGURE", "DIR")


@dataclass(frozen=True, slots=True)
class Completion:
    """What is completed behind a command.

    Attributes
    ----------
    command, summary
        Its name and what it does.
    options
        Option -> its help, and what follows it: a constant of above, its choices, or an empty
        string for a flag.
    positional
        "toml" or "zarr" for what ends its argument, or its choices.
    """

    command: str
    summary: str
    options: dict[str, tuple[str, str]]
    positional: str


def completions(commands: Sequence[Command]) -> list[Completion]:
    """Return what is completed behind each command, as its arguments declare it."""
    found = []
    for command in commands:
        parser = argparse.ArgumentParser()
        command.add_arguments(parser)
        options, positional = {}, ""
        for action in parser._actions:  # noqa: SLF001  (argparse offers no other list)
            choices = " ".join(map(str, action.choices or ()))
            if not action.option_strings:
                metavar = str(action.metavar)
                positional = positional or choices or (
                    "toml" if "PIPELINE" in metavar else "zarr")
                continue
            if action.nargs == 0:
                follows = ""
            elif action.dest in ("settings", "at"):
                follows = NAMES
            elif action.metavar in AXIS_METAVARS:
                follows = AXES
            else:
                follows = choices or (FILES if action.metavar in FILE_METAVARS else NOTHING)
            for option in action.option_strings:
                options[option] = str(action.help), follows
        found.append(Completion(command.name, command.summary, options, positional))
    return found


def bash(commands: Sequence[Completion], names: Sequence[str]) -> str:
    """Return the script for bash."""
    cases = []
    for each in commands:
        follow = [
            f'        "{each.command} {option}") {_bash_reply(follows)};;'
            for option, (_, follows) in each.options.items() if follows
        ]
        files = {"toml": "_sweep_files toml", "zarr": "_sweep_files"}
        rest = files.get(each.positional, f'candidates="{each.positional}"')
        flags = f'candidates="{" ".join(each.options)}"'
        cases += [
            *follow,
            f'        "{each.command} "*) if [[ $token != -* ]]; then {rest}; else {flags}; fi;;',
        ]
    return "\n".join([
        "# bash completion of sweep; read it by: source <(sweep completion bash)",
        "_sweep_files() {",
        '    mapfile -t COMPREPLY < <(compgen -d -- "$token"',
        '        [[ $1 ]] && compgen -f -X "!*.$1" -- "$token")',
        "    compopt -o filenames",
        "}",
        "_sweep() {",
        "    local line=${COMP_LINE:0:COMP_POINT} names candidates= part",
        f'    names="{" ".join(f"{name}=" for name in names)}"',
        "    local token=${line##*[[:space:]]}",
        '    local -a words=(${line%"$token"})',
        "    if (( ${#words[@]} == 1 )); then",
        f'        candidates="{" ".join(each.command for each in commands)} --help --version"',
        '    else case "${words[1]} ${words[-1]}" in',
        *cases,
        "    esac; fi",
        "    [[ -n $candidates ]] || return",
        '    mapfile -t COMPREPLY < <(compgen -W "$candidates" -- "$token")',
        "    [[ ${COMPREPLY[0]} == *= ]] && compopt -o nospace",
        "    # Readline replaces what follows the last equals sign only.",
        '    part=${token%"${token##*=}"}',
        '    COMPREPLY=("${COMPREPLY[@]#"$part"}")',
        "}",
        "complete -F _sweep sweep",
        "",
    ])


def _bash_reply(follows: str) -> str:
    if follows == NAMES:
        return (
            'part=${token%"${token##*,}"}; [[ ${token##*,} == *=* ]] || '
            'candidates=$(printf "%s " ${names// / }); '
            'candidates=" $candidates"; candidates=${candidates// / $part}'
        )
    if follows == AXES:
        return (
            'part=${token%"${token##*,}"}; candidates=$(printf "%s " ${names//=/}); '
            'candidates=" $candidates"; candidates=${candidates// / $part}'
        )
    if follows == FILES:
        return "compopt -o default"
    return ":" if follows == NOTHING else f'candidates="{follows}"'


def zsh(commands: Sequence[Completion], names: Sequence[str]) -> str:
    """Return the script for zsh."""
    cases = []
    for each in commands:
        for option, (_, follows) in each.options.items():
            if follows:
                cases.append(f'        "{each.command} {option}") {_zsh_reply(follows)};;')
        files = {"toml": "_files -g '*.(toml|zarr)'", "zarr": "_files -/"}
        rest = files.get(each.positional, f"compadd -- {each.positional}")
        cases.append(
            f'        "{each.command} "*) if [[ $PREFIX == -* ]]; then '
            f'compadd -- {" ".join(each.options)}; else {rest}; fi;;'
        )
    return "\n".join([
        "#compdef sweep",
        "# zsh completion of sweep; read it by: source <(sweep completion zsh)",
        "_sweep() {",
        "    local -a names",
        f'    names=({" ".join(f"{name}=" for name in names)})',
        "    if (( CURRENT == 2 )); then",
        f'        compadd -- {" ".join(each.command for each in commands)} --help --version',
        "        return",
        "    fi",
        '    case "$words[2] $words[CURRENT-1]" in',
        *cases,
        "    esac",
        "}",
        "compdef _sweep sweep",
        "",
    ])


def _zsh_reply(follows: str) -> str:
    if follows == NAMES:
        return "compset -P '*,'; compadd -S '' -- $names"
    if follows == AXES:
        return "compset -P '*,'; compadd -- ${names%=}"
    if follows == FILES:
        return "_files"
    return ":" if follows == NOTHING else f"compadd -- {follows}"


def fish(commands: Sequence[Completion], names: Sequence[str]) -> str:
    """Return the script for fish."""
    lines = ["# fish completion of sweep; read it by: sweep completion fish | source",
             "complete -c sweep -f"]
    written = " ".join(f"{name}=" for name in names)
    for each in commands:
        summary = _quoted(each.summary)
        lines.append(
            f"complete -c sweep -n __fish_use_subcommand -a {each.command} -d {summary}"
        )
        behind = f"complete -c sweep -n '__fish_seen_subcommand_from {each.command}'"
        if each.positional in ("toml", "zarr"):
            lines.append(f"{behind} -F")
        else:
            lines.append(f"{behind} -a {_quoted(each.positional)}")
        for option, (meaning, follows) in each.options.items():
            flag = f"-l {option[2:]}" if option.startswith("--") else f"-s {option[1:]}"
            reply = {
                "": "", NAMES: f" -x -a {_quoted(written)}",
                AXES: f" -x -a {_quoted(' '.join(names))}", FILES: " -r -F", NOTHING: " -x",
            }.get(follows, f" -x -a {_quoted(follows)}")
            lines.append(f"{behind} {flag}{reply} -d {_quoted(meaning)}")
    return "\n".join([*lines, ""])


def _quoted(text: str) -> str:
    escaped = text.replace("\\", "\\\\").replace("'", "\\'")
    return f"'{escaped}'"


SHELLS: dict[str, Callable[[Sequence[Completion], Sequence[str]], str]] = {
    "bash": bash, "zsh": zsh, "fish": fish,
}


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("shell", metavar="SHELL", choices=tuple(SHELLS), help="bash, zsh or fish")


def _execute(options: argparse.Namespace) -> int:
    from sweep.cli.parser import COMMANDS  # noqa: PLC0415  (it imports this module)
    from sweep.plan.axes import TRIAL  # noqa: PLC0415
    from sweep.plan.parameters import PARAMETERS  # noqa: PLC0415

    print(SHELLS[options.shell](completions(COMMANDS), sorted([*PARAMETERS, TRIAL])), end="")
    return 0


COMPLETION = Command(
    "completion", "print a script by which a shell completes commands and names",
    "pipelines/README.md",
    (
        Example("sweep completion bash", "prints it for bash: source <(sweep completion bash)"),
        Example("sweep completion fish", "prints it for fish: sweep completion fish | source"),
    ),
    _add_arguments, _execute,
)
