"""``sweep show``."""

from __future__ import annotations

import argparse
import shlex

from sweep.cli.arguments import add_cell, add_picture, add_pipeline, read_pipeline
from sweep.cli.command import Command, Example
from sweep.cli.output import check_png, say, say_next, write_png


def _add_arguments(parser: argparse.ArgumentParser) -> None:
    add_pipeline(parser)
    add_cell(parser, "the pose and its configuration")
    add_picture(parser, "scene.png")


def _execute(options: argparse.Namespace) -> int:
    pipeline = read_pipeline(options)
    check_png(options.output)
    from sweep.evaluation.inspection import inspect_scene  # noqa: PLC0415
    from sweep.plan.cell_selection import cell, coordinates_text  # noqa: PLC0415
    from sweep.report.scene_drawing import draw_scene  # noqa: PLC0415

    single = cell(pipeline, ",".join(options.at))
    scene = inspect_scene(single, whole_frame=options.full)
    image = scene.image if options.plain else draw_scene(scene, coordinates_text(pipeline, single))
    write_png(options.output, image)
    say(f"{options.output}: {scene.detection.name}, {scene.estimate.name}")
    settings = [word for setting in options.settings for word in ("--set", setting)]
    say_next(shlex.join(["sweep", "plan", options.pipeline, *settings]))
    return 0


SHOW = Command(
    "show", "draw the image of one pose with the detections in it",
    "pipelines/README.md",
    (
        Example(
            "sweep show pipelines/smoke.toml --at distance_m=0.3,tilt_deg=45",
            "draws this pose into scene.png",
        ),
        Example(
            "sweep show pipelines/faults.toml --full --plain -o frame.png",
            "writes the whole frame of the first pose, without annotations",
        ),
    ),
    _add_arguments, _execute,
)
