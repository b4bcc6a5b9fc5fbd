"""The receipt of a block: what commits it, counts its flags, and holds its chunks' digests.

A receipt is the last thing that is written of a block, as JSON. Stores of format 2 (sweep 0.5)
list the digests by position, in the order of that format's variables; later ones name them. From
format 4 on, a receipt names its block, so that it commits no other one.
"""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from sweep.measure.flags import DetectionStatus
from sweep.plan.schema import schema_of

POSITIONAL_FORMAT = 2
"""The store format whose receipts list digests by position."""

NAMING_FORMAT = 4
"""The store format from which on receipts name their block."""

REQUIRED = {
    "run_id", "processor", "scenes", "detection", "estimate", "seconds", "failures", "written",
    "digests",
}
"""Keys that every receipt has."""

STAGES = ("scene", "detection", "estimation")


@dataclass(frozen=True, slots=True)
class RecordedFailure:
    """A cell of a block whose computation raised or whose process died.

    Attributes
    ----------
    scene
        Number of the scene within the block.
    kind
        "failed" (it raised) or "crashed" (its process died).
    stage
        "scene", "detection" or "estimation".
    setting, estimator
        Numbers of the detector setting and of the estimator; None for an earlier stage.
    text
        The end of the traceback, or how the process died.
    """

    scene: int
    kind: str
    stage: str
    setting: int | None
    estimator: int | None
    text: str

    @classmethod
    def from_dict(cls, content: object) -> RecordedFailure:
        """Return the failure that a receipt's JSON holds; ValueError if it is none."""
        if not isinstance(content, dict):
            raise ValueError("failures: expected objects")  # noqa: TRY004  (as all that is read)
        setting, estimator = content.get("setting"), content.get("estimator")
        valid = (
            _is_count(content.get("scene"))
            and content.get("kind") in ("failed", "crashed")
            and content.get("stage") in STAGES
            and (setting is None or _is_count(setting))
            and (estimator is None or _is_count(estimator))
            and isinstance(content.get("text"), str)
        )
        if not valid:
            raise ValueError("failures: not a failure")
        return cls(
            content["scene"], content["kind"], content["stage"], setting, estimator,
            content["text"],
        )


@dataclass(frozen=True, slots=True)
class Receipt:
    """What commits a block.

    Attributes
    ----------
    run_id
        The run that the store belongs to.
    processor
        Features of the processor that computed the block.
    scenes
        Number of scenes of the block.
    computed
        "scenes", "detections" and "estimates" -> how many were computed and not reused.
    detection, estimate
        How often each flag occurs, by its value.
    seconds
        Stage -> seconds for each configuration; empty where nothing was computed.
    failures
        The cells that failed or crashed, as far as they are recorded.
    wall_s
        Seconds from the block's start to its receipt.
    written
        Time at which it was computed, seconds since 1970.
    digests
        Variable -> CRC-32 of its chunk.
    block
        The block's number; None in stores of formats before 4.
    basis
        A digest of what the block's needed scenes follow from: the rule by which sampling stops,
        and the results of earlier waves; None where all scenes are needed.
    """

    run_id: str
    processor: str
    scenes: int
    computed: Mapping[str, int]
    detection: Sequence[int]
    estimate: Sequence[int]
    seconds: Mapping[str, Sequence[float]]
    failures: Sequence[RecordedFailure]
    wall_s: float
    written: float
    digests: Mapping[str, int] = field(default_factory=dict)
    block: int | None = None
    basis: int | None = None

    @property
    def scenes_needed(self) -> int:
        """How many of its scenes were needed, for the precision that was asked for."""
        unneeded = sum(self.detection[DetectionStatus.not_needed :][:1])
        return self.scenes - unneeded * self.scenes // max(sum(self.detection), 1)

    @property
    def any_needed(self) -> bool:
        """Whether any of its scenes was needed; if none was, it has chunks of flags alone."""
        return self.basis is None or self.scenes_needed > 0

    def to_json(self, store_format: int) -> str:
        """Return the text that a store of a format holds."""
        content = asdict(self)
        if store_format == POSITIONAL_FORMAT:
            content["digests"] = [
                self.digests[variable.name] for variable in schema_of(store_format)
            ]
        if store_format < NAMING_FORMAT:
            del content["block"]
        if self.basis is None:
            del content["basis"]
        return json.dumps(content, separators=(",", ":"))

    @classmethod
    def from_json(cls, text: str) -> Receipt:
        """Return the receipt that a text holds, of whatever format.

        Raises
        ------
        ValueError
            If it is incomplete, or a value is of a wrong type.
        """
        try:
            content = json.loads(text)
        except RecursionError:
            raise ValueError("nested too deeply") from None
        if not isinstance(content, dict) or not content.keys() >= REQUIRED:
            raise ValueError("incomplete")
        valid = (
            isinstance(content["run_id"], str)
            and isinstance(content["processor"], str)
            and _is_count(content["scenes"])
            and are_counts(content["detection"])
            and are_counts(content["estimate"])
            and _are_seconds(content["seconds"])
            and isinstance(content["failures"], list)
            and _is_number(content["written"])
            and _is_number(content.get("wall_s", 0.0))
            and (content.get("block") is None or _is_count(content["block"]))
            and (content.get("basis") is None or _is_count(content["basis"]))
        )
        if not valid:
            raise ValueError("a value of a wrong type")
        return cls(
            run_id=content["run_id"],
            processor=content["processor"],
            scenes=content["scenes"],
            computed=_computed(content.get("computed", {})),
            detection=content["detection"],
            estimate=content["estimate"],
            seconds={stage: content["seconds"][stage] for stage in STAGES},
            failures=tuple(RecordedFailure.from_dict(each) for each in content["failures"]),
            wall_s=content.get("wall_s", 0.0),
            written=content["written"],
            digests=_digests(content["digests"]),
            block=content.get("block"),
            basis=content.get("basis"),
        )

    def check(self, scenes: int, settings: int, estimates: int) -> None:
        """Raise ValueError if this is no receipt of a block of so many scenes.

        ``settings`` and ``estimates`` are the configurations of detection, and of detection and
        estimation together.
        """
        lengths = {"scene": 1, "detection": settings, "estimation": estimates}
        fits = (
            self.scenes == scenes
            and sum(self.detection) == scenes * settings
            and sum(self.estimate) == scenes * estimates
            and all(len(self.seconds[stage]) in (0, lengths[stage]) for stage in STAGES)
            and all(
                failure.scene < scenes
                and (failure.setting is None or failure.setting < settings)
                and (failure.estimator is None or failure.estimator < estimates // settings)
                for failure in self.failures
            )
        )
        if not fits:
            raise ValueError("not a receipt of this block")


def are_counts(values: Any) -> bool:
    """Return whether a JSON value is a list of integers of at least 0."""
    return isinstance(values, list) and all(_is_count(value) for value in values)


def _is_count(value: Any) -> bool:
    return type(value) is int and value >= 0


def _is_number(value: Any) -> bool:
    return isinstance(value, (int, float))


def _are_seconds(values: Any) -> bool:
    return isinstance(values, dict) and all(
        isinstance(values.get(stage), list) and all(_is_number(value) for value in values[stage])
        for stage in STAGES
    )


def _computed(values: Any) -> dict[str, int]:
    if not isinstance(values, dict) or not all(_is_count(value) for value in values.values()):
        raise ValueError("computed: expected counts")
    return values


def _digests(values: Any) -> dict[str, int]:
    """Return the digests by variable."""
    if isinstance(values, list):
        names = [variable.name for variable in schema_of(POSITIONAL_FORMAT)]
        if len(values) != len(names):
            raise ValueError("digests: another number of variables")
        values = dict(zip(names, values, strict=True))
    if not isinstance(values, dict) or not all(_is_count(value) for value in values.values()):
        raise ValueError("digests: expected a CRC-32 for each variable")
    return values
