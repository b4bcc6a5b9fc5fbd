"""OpenCV's detector of another environment: the same images, searched in a process of its own."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sweep.environments.identity import EnvironmentIdentity, identify, process_of
from sweep.environments.interpreters import find_python
from sweep.environments.process import Answer, DetectorProcessError, SearchDefinition
from sweep.measure.detector import DetectorOutput, DetectorSetting, perimeter_rates
from sweep.processes import OUTSIDE_SIGNALS


@dataclass(frozen=True, slots=True)
class ForeignSetting:
    """One setting of OpenCV's detector in another environment.

    Attributes
    ----------
    environment
        A name, or the path of a Python or of a virtual environment.
    folder
        Where relative paths start.
    setting
        The setting; fields that the other OpenCV lacks have their defaults.
    given
        The fields that the pipeline gives; the others have the other OpenCV's own defaults.
    """

    environment: str
    folder: str
    setting: DetectorSetting
    given: frozenset[str]


class ForeignSearchError(Exception):
    """A search that raised in the other environment, or ended its process."""


class ForeignDetector:
    """One detector setting in the process of another environment.

    Fields that the pipeline does not give have the other OpenCV's own defaults, as its users have
    them: what a field means may have changed with its default (``minMarkerDistanceRate`` did).

    Parameters
    ----------
    setting
        The setting.

    Raises
    ------
    EnvironmentFaultError
        If the environment cannot be used.
    """

    def __init__(self, setting: ForeignSetting) -> None:
        self.environment = setting.environment
        self._setting = setting.setting
        self._python = find_python(setting.environment, setting.folder)
        self._fields = identify(setting.environment, setting.folder).fields
        self._given = setting.given
        self._definitions: dict[tuple[str, int, int], SearchDefinition] = {}

    def __call__(
        self, image: NDArray[np.uint8], dictionary: str, frame_side: int
    ) -> DetectorOutput:
        """Search an image (h, w): a window of a frame whose larger side is ``frame_side``.

        Raises
        ------
        ForeignSearchError
            If the search raises there, or ends its process.
        """
        (answer,) = self.search_all([image], [dictionary], [frame_side])
        if answer.error:
            raise ForeignSearchError(answer.error)
        return detector_output(answer)

    def search_all(
        self, images: Sequence[NDArray[np.uint8]], dictionaries: Sequence[str],
        frame_sides: Sequence[int],
    ) -> list[Answer]:
        """Search images, each as a call does, on one way there and back.

        An image whose search ends the process is searched again alone in a new one; ``died`` of its
        answer says whether it ended that, too.
        """
        definitions = [
            self._definition(dictionary, max(image.shape), side)
            for image, dictionary, side in zip(images, dictionaries, frame_sides, strict=True)
        ]
        try:
            return process_of(self._python).search(images, definitions)
        except DetectorProcessError:
            return [
                self._alone(image, definition)
                for image, definition in zip(images, definitions, strict=True)
            ]

    def _alone(self, image: NDArray[np.uint8], definition: SearchDefinition) -> Answer:
        how = ""
        for _ in range(2):
            try:
                (answer,) = process_of(self._python).search([image], [definition])
            except DetectorProcessError as error:
                how = str(error)
                if how not in OUTSIDE_SIGNALS:
                    break
            else:
                return answer
        return Answer.without(
            f"the process of environment {self.environment} ended: {how}", died=True,
            of_the_machine=how in OUTSIDE_SIGNALS,
        )

    def _definition(self, dictionary: str, side: int, frame_side: int) -> SearchDefinition:
        key = dictionary, side, frame_side
        known = self._definitions.get(key)
        if known is None:
            values = {
                name: value for name, value in dataclasses.asdict(self._setting).items()
                if name in self._given and name in self._fields
            }
            low, high = perimeter_rates(self._setting, side, frame_side)
            values |= {
                "cornerRefinementMethod": self._setting.cornerRefinementMethod.upper(),
                "minMarkerPerimeterRate": low, "maxMarkerPerimeterRate": high,
            }
            known = self._definitions[key] = SearchDefinition(dictionary, tuple(values.items()))
        return known


def own_defaults(identity: EnvironmentIdentity, given: Collection[str]) -> dict[str, Any]:
    """Return the fields that are not given and whose default there is not the declared one."""
    declared = dataclasses.asdict(DetectorSetting())
    return {
        name: value for name, value in sorted(identity.fields.items())
        if name in declared and name not in given and name != "cornerRefinementMethod"
        and not math.isclose(value, declared[name], rel_tol=1e-6)  # OpenCV has some as float32
    }


def provenance(identity: EnvironmentIdentity, given: Collection[str]) -> str:
    """Return one line that is the same where an environment's results are."""
    own = own_defaults(identity, given)
    return ", ".join([
        f"OpenCV {identity.opencv} {identity.opencv_build}",
        f"NumPy {identity.numpy} {identity.numpy_build}",
        *(f"{name} {value:g}" for name, value in own.items()),
    ])


def detector_output(answer: Answer) -> DetectorOutput:
    """Return an answer as OpenCV's Python interface gives it."""
    return (
        list(answer.corners[:, None]), answer.ids if len(answer.ids) else None,
        list(answer.rejected[:, None]),
    )
