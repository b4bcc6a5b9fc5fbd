"""``sweep environments``: Pythons with other versions of OpenCV, made, listed and removed."""

from __future__ import annotations

import argparse

from sweep.cli.arguments import add_json
from sweep.cli.command import Command, Example
from sweep.cli.output import print_json, say, say_next


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "action", metavar="ACTION", choices=("add", "list", "remove"),
        help="add NAME REQUIREMENT ..., list, or remove NAME",
    )
    parser.add_argument(
        "name", metavar="NAME", nargs="?",
        help='the environment\'s name, which pipelines give as environment = "NAME"',
    )
    parser.add_argument(
        "requirements", metavar="REQUIREMENT", nargs="*",
        help="what pip installs: opencv-contrib-python-headless==4.8.1.78",
    )
    parser.add_argument(
        "--python", metavar="PATH", help="the Python that makes it (default: this one)"
    )
    add_json(parser)


def _execute(options: argparse.Namespace) -> int:
    from sweep.environments.virtual_environments import (  # noqa: PLC0415
        ListedEnvironment,
        add,
        listed,
        remove,
    )
    from sweep.errors import ArgumentError  # noqa: PLC0415

    given = options.name is not None
    if options.action == "list" and (given or options.requirements):
        raise ArgumentError("name", options.name, "list takes no name")
    if options.action != "list" and not given:
        raise ArgumentError("name", "", f"expected the name of what to {options.action}")
    if options.action == "add" and not options.requirements:
        raise ArgumentError(
            "requirements", "", "expected what to install, such as "
            "opencv-contrib-python-headless==4.8.1.78"
        )
    if options.action == "remove" and options.requirements:
        raise ArgumentError(
            "requirements", options.requirements[0], "one environment is removed at a time"
        )

    def line(each: ListedEnvironment) -> str:
        what = each.fault or (
            f"OpenCV {each.opencv}, NumPy {each.numpy}, Python {each.python_version}"
        )
        return f"{each.name:20} {what}  {each.python}"

    if options.action == "remove":
        remove(options.name)
        found = []
    else:
        found = listed() if options.action == "list" else [
            add(options.name, options.requirements, options.python)
        ]
    if options.json:
        print_json({"environments": [each.to_json() for each in found]})
        return 0
    for each in found:
        say(line(each))
    if options.action == "add":
        say_next(
            f"sweep run PIPELINE --set 'environment=[\"installed\", \"{options.name}\"]'",
            "both on the same images",
        )
    elif options.action == "list" and not found:
        say("no environment by name")
        say_next("sweep environments add opencv-4.8 opencv-contrib-python-headless==4.8.1.78")
    return 0


ENVIRONMENTS = Command(
    "environments",
    "make, list and remove Pythons with other OpenCVs",
    "pipelines/opencv_versions/README.md",
    (
        Example(
            "sweep environments add opencv-4.8 opencv-contrib-python-headless==4.8.1.78",
            'install it where environment = "opencv-4.8" finds it',
        ),
        Example("sweep environments list", "what there is, with versions"),
    ),
    _add_arguments,
    _execute,
)
