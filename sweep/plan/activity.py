"""Which parts of the model and the measurement a pipeline needs, and why."""

from __future__ import annotations

from dataclasses import dataclass

from sweep.measure.detector import full_frame_reason, margin_px
from sweep.model.camera import canonical_distortion
from sweep.plan.grid import detector_settings
from sweep.plan.parameters import PARAMETERS
from sweep.plan.pipeline import Pipeline


@dataclass(frozen=True, slots=True)
class Part:
    """A part of the work: what it is, whether it runs, and the reason."""

    name: str
    active: bool
    reason: str


def parts(pipeline: Pipeline) -> list[Part]:
    """Return every optional part, active or not."""
    lens = pipeline.any_value("distortion", lambda value: len(canonical_distortion(value)) > 0)
    draws = [*pipeline.distributions]
    if pipeline.any_value("jitter_px", lambda value: value > 0):
        draws.append("jitter_px")
    renderers = sorted(set(pipeline.values_of("renderer")))
    image = pipeline.any_value("background", lambda value: isinstance(value, str))
    asked = pipeline.any_value("window", lambda value: value == "full")
    settings = detector_settings(pipeline)
    whole = sorted({reason for s in settings if (reason := full_frame_reason(s)) is not None})
    if image:
        whole.append("the background is an image: clutter near the marker may change what is found")
    if asked:
        whole.append('window = "full"')
    margins = sorted({margin_px(setting) for setting in settings})
    guarded = pipeline.any_value("guarded", bool)
    beliefs = [
        name for name in PARAMETERS
        if name.startswith("believed_") and pipeline.fixed.get(name, "varies") is not None
    ]
    return [
        Part("lens distortion", lens, "distortion is given" if lens else "distortion is empty"),
        Part("random draws", bool(draws), ", ".join(draws) if draws else "nothing is random"),
        Part("background image", image, "background names a file" if image else "a level"),
        Part(
            "window", not (asked or image),
            f"{', '.join(str(m) for m in margins)} px around what the marker can influence"
            if not (asked or image) else "the full frame",
        ),
        Part("full frame", bool(whole), "; ".join(whole) if whole else "no setting needs it"),
        Part("renderer", True, ", ".join(renderers)),
        Part(
            "solver guard", guarded,
            "guarded = true" if guarded else "guarded = false: plain cv2.solvePnP",
        ),
        Part(
            "mistaken beliefs", bool(beliefs),
            ", ".join(beliefs) if beliefs else "the estimator knows the truth of camera and size",
        ),
    ]
