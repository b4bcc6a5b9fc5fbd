"""What commits a block: its receipt."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import google_crc32c
import numpy as np
from numcodecs.vlen import VLenUTF8
from numcodecs.zstd import Zstd

from sweep.measure.flags import DetectionStatus
from sweep.store.layout import ZSTD_LEVEL, checksum_of

# --------------------------------------------------------------------------------------------------
# The receipt of a block: what commits it, counts its flags, and lists its chunks' checksums.
#
# A receipt is the last thing that is written of a block, as JSON. It names its block, so that it
# commits no other one.

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
    processors
        Features of the processors that computed its cells, in order: several where cells were
        taken from other stores, or computed on another basis before.
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
    checksums
        Variable -> the CRC-32C at the end of its chunk.
    block
        The block's number; None until it is written.
    basis
        A digest of what the block's needed scenes follow from: the rule by which sampling stops,
        and the results of earlier waves; None where all scenes are needed.
    """

    run_id: str
    processors: Sequence[str]
    scenes: int
    computed: Mapping[str, int]
    detection: Sequence[int]
    estimate: Sequence[int]
    seconds: Mapping[str, Sequence[float]]
    failures: Sequence[RecordedFailure]
    wall_s: float
    written: float
    checksums: Mapping[str, int] = field(default_factory=dict)
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

    def to_json(self) -> str:
        """Return the text that a store holds."""
        content = asdict(self)
        if self.basis is None:
            del content["basis"]
        return json.dumps(content, separators=(",", ":"))

    @classmethod
    def from_json(cls, text: str) -> Receipt:
        """Return the receipt that a text holds.

        Raises
        ------
        ValueError
            If it is incomplete, or a value is of a wrong type.
        """
        try:
            content = json.loads(text)
        except RecursionError:
            raise ValueError("nested too deeply") from None
        if not isinstance(content, dict) or not content.keys() >= CHECKS.keys():
            raise ValueError("incomplete")
        basis = content.get("basis")
        if not (basis is None or _is_count(basis)):
            raise ValueError("basis: a value of a wrong type")
        for key, valid in CHECKS.items():
            if not valid(content[key]):
                raise ValueError(f"{key}: a value of a wrong type")
        return cls(**{key: content[key] for key in CHECKS} | {
            "processors": tuple(content["processors"]),
            "seconds": {stage: content["seconds"][stage] for stage in STAGES},
            "failures": tuple(RecordedFailure.from_dict(each) for each in content["failures"]),
        }, basis=basis)

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


def _are_texts(values: Any) -> bool:
    return isinstance(values, list) and all(isinstance(each, str) for each in values)


def _are_seconds(values: Any) -> bool:
    return isinstance(values, dict) and all(
        isinstance(values.get(stage), list) and all(_is_number(value) for value in values[stage])
        for stage in STAGES
    )


def _are_named_counts(values: Any) -> bool:
    return isinstance(values, dict) and all(_is_count(value) for value in values.values())


CHECKS: dict[str, Callable[[Any], bool]] = {
    "run_id": lambda value: isinstance(value, str), "processors": _are_texts,
    "scenes": _is_count, "computed": _are_named_counts, "detection": are_counts,
    "estimate": are_counts, "seconds": _are_seconds,
    "failures": lambda value: isinstance(value, list), "wall_s": _is_number,
    "written": _is_number, "checksums": _are_named_counts, "block": _is_count,
}
"""Keys that every receipt has, and what their values must be."""


# --------------------------------------------------------------------------------------------------
# The text of a receipt from the bytes of its chunk, and back.
#
# Zarr decodes each chunk in a thread of its own: for 10^5 receipts that takes half a minute of
# processor time, four times what the same codecs take when they are called one after another.

def decoded(content: bytes) -> str:
    """Return the text that a chunk holds; ValueError if it is damaged."""
    body = content[:-4]
    if google_crc32c.value(body) != checksum_of(content):
        raise ValueError("a receipt's checksum differs")
    try:
        (text,) = VLenUTF8().decode(Zstd().decode(body))
    except RuntimeError as error:
        raise ValueError(str(error)) from None
    return str(text)


def encoded(text: str) -> bytes:
    """Return the content of a chunk that holds a text, the same bytes as Zarr writes."""
    body = bytes(Zstd(ZSTD_LEVEL).encode(VLenUTF8().encode(np.array([text], dtype=object))))
    checksum: int = google_crc32c.value(body)
    return body + checksum.to_bytes(4, "little")
