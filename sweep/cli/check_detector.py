"""``sweep check-detector``."""

from __future__ import annotations

import argparse
import shlex

from sweep.cli.arguments import add_json
from sweep.cli.command import Command, Example
from sweep.cli.output import print_json, say, say_next


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "detector", metavar="NAME",
        help="opencv, the name of an installed plug-in, or module:name of a file in this folder",
    )
    parser.add_argument(
        "--set", action="append", default=[], metavar="KEY=VALUE", dest="settings",
        help="give a setting of the detector this TOML value; may be repeated",
    )
    parser.add_argument(
        "--dictionary", metavar="NAME",
        help="dictionary of the markers (default: DICT_APRILTAG_36h11, or the detector's first)",
    )
    parser.add_argument(
        "--calls", type=int, default=400, metavar="N",
        help="searches over which memory is watched (default: 400)",
    )
    parser.add_argument(
        "--time-limit", type=float, default=60.0, metavar="S", dest="time_limit_s",
        help="seconds after which a step is taken for endless (default: 60)",
    )
    add_json(parser)


def _execute(options: argparse.Namespace) -> int:
    from sweep.conformance.check import check_detector  # noqa: PLC0415

    report = check_detector(
        options.detector, options.dictionary, options.settings, calls=options.calls,
        time_limit_s=options.time_limit_s,
    )
    if options.json:
        print_json({
            "detector": report.detector, "dictionary": report.dictionary,
            "versions": report.versions, "conforms": report.conforms,
            "scenes": report.scenes, "detected": report.detected, "offset_px": report.offset_px,
            "rms_px": report.rms_px, "milliseconds": report.milliseconds,
            "findings": [
                {"check": finding.check, "verdict": finding.verdict.value, "text": finding.text}
                for finding in report.findings
            ],
        })
        return 0 if report.conforms else 1
    versions = ", ".join(f"{name} {version}" for name, version in report.versions.items())
    say(f"{report.detector}{f' ({versions})' if versions else ''} on {report.dictionary}: "
        f"{'conforms' if report.conforms else 'does not conform'}")
    for finding in report.findings:
        say(f"  {finding.verdict.value:5}  {finding.check}: {finding.text}")
    if report.offset_px is not None and report.rms_px is not None:
        x, y = report.offset_px
        say(
            f"  corners: mean offset ({x:+.3f}, {y:+.3f}) px, RMS beside it "
            f"{report.rms_px:.3f} px, {report.milliseconds:.1f} ms a frame of 640 x 480 px"
        )
    if report.conforms:
        chosen = f'detector.detector="{report.detector}"'
        say_next(
            f"sweep run PIPELINE --set {shlex.quote(chosen)}", "measures it on your scenes"
        )
    return 0 if report.conforms else 1


CHECK_DETECTOR = Command(
    "check-detector", "try whether a detector's conventions are what it declares",
    "sweep/adapters/README.md",
    (
        Example(
            "sweep check-detector opencv --set 'cornerRefinementMethod=\"subpix\"'",
            "tries OpenCV's own detector with its sub-pixel refinement",
        ),
        Example(
            "sweep check-detector mine:DETECTOR --calls 10000",
            "tries DETECTOR of mine.py in this folder, and its memory over 10,000 calls",
        ),
    ),
    _add_arguments, _execute,
)
