"""What commits a block: its receipt, the last file that is written of it."""

from __future__ import annotations

import json
import struct
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field

from sweep.measure.flags import DetectionStatus
from sweep.store.layout import RECEIPTS, packed, unpacked


def receipt_key(number: int) -> str:
    """Return the key of a block's receipt."""
    return f"{RECEIPTS}/c/{number}"


STAGES = ("scene", "detection", "estimation")


@dataclass(frozen=True, slots=True)
class FailedCell:
    """A scene, or a scene with a configuration, that raised or whose process died.

    Attributes
    ----------
    at
        Its coordinates, as ``sweep repro --at`` takes them.
    kind
        "failed" (it raised) or "crashed" (its process died).
    stage
        "scene", "detection" or "estimation".
    text
        The end of the traceback, or how the process died.
    """

    at: str
    kind: str
    stage: str
    text: str

    @property
    def reason(self) -> str:
        """The first line of the exception's message in a traceback; of other texts the last."""
        lines = self.text.strip().splitlines()
        frames = [number for number, line in enumerate(lines) if line.startswith('  File "')]
        raised = (line for line in lines[frames[-1] + 1 :] if not line[:1].isspace()) \
            if frames else iter(())
        return next(raised, lines[-1] if lines else "")


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
    failures: Sequence[FailedCell]
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

    def to_bytes(self) -> bytes:
        """Return the chunk that a store holds: a text of JSON, the bytes that Zarr writes."""
        text = json.dumps(asdict(self), separators=(",", ":")).encode()
        # As the codec "vlen-utf8" has it: how many texts, then the length of each before it.
        return packed(struct.pack("<II", 1, len(text)) + text)

    @classmethod
    def from_bytes(cls, chunk: bytes | None) -> Receipt:
        """Return the receipt that a chunk holds.

        Raises
        ------
        ValueError
            If the chunk is missing, fails its checksum, or holds something else.
        """
        if chunk is None:
            raise ValueError("missing")
        try:
            content = json.loads(unpacked(chunk)[8:])
            failures = tuple(FailedCell(**failure) for failure in content["failures"])
            return cls(**content | {
                "processors": tuple(content["processors"]), "failures": failures,
            })
        except (AttributeError, KeyError, TypeError, RuntimeError) as error:
            raise ValueError(f"no receipt: {error}") from None
