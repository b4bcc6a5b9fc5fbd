"""``sweep plugins``."""

from __future__ import annotations

import argparse

from sweep.cli.arguments import add_json
from sweep.cli.command import Command, Example
from sweep.cli.output import print_json, say, say_next


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "name", metavar="NAME", nargs="?",
        help="a plug-in to describe: the name of an installed one, or file:name in this folder",
    )
    add_json(parser)


def _execute(options: argparse.Namespace) -> int:
    from sweep.plugins.listing import described, installed  # noqa: PLC0415

    if options.name is None:
        every = installed()
        if options.json:
            print_json({"plugins": every})
            return 0
        for each in every:
            say(f"{each['kind']:10} {each['name']:20} of {each['distribution']}")
        if not every:
            say("no plug-in is installed")
        say_next("sweep plugins NAME", "describes one, and says whether it can be used")
        return 0
    found = [plugin.to_json() for plugin in described(options.name)]
    if options.json:
        print_json({"plugins": found})
        return 0
    for plugin in found:
        say(f"{plugin['kind']} {plugin['name']}" + (
            f": {plugin['meaning']}" if plugin["meaning"] else ""
        ))
        for distribution, version in plugin["versions"].items():
            say(f"  needs      {distribution} {version}")
        if plugin["dictionaries"]:
            say(f"  knows      {', '.join(plugin['dictionaries'])}")
        for setting in plugin["settings"]:
            unit = f" {setting['unit']}" if "unit" in setting else ""
            say(f"  setting    {setting['name']} = {setting['default']}{unit}: "
                f"{setting['meaning']}")
    return 0


PLUGINS = Command(
    "plugins", "list the plug-ins that are installed, or describe one",
    "pipelines/plugins/README.md",
    (
        Example("sweep plugins", "lists detectors, estimators, effects and renderers"),
        Example("sweep plugins pyapriltags", "imports one, and lists its settings"),
    ),
    _add_arguments, _execute,
)
