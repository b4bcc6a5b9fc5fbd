"""The conformance test of a detector: every step in a child process, every finding a line."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np

from sweep.conformance import trial
from sweep.conformance.conventions import Conventions, conventions, offset_fault, order_faults
from sweep.conformance.scenes import SCENES, trial_pipeline
from sweep.errors import ArgumentError, MachineFaultError, PipelineError, SweepError
from sweep.isolation.child_process import Child, ChildDiedError, ChildRaisedError, last_line
from sweep.measure.detectors import OPENCV
from sweep.model.marker import marker_count, missing_package
from sweep.plan.grid import detector_settings
from sweep.plan.parameters import PARAMETERS
from sweep.plugins import DetectorPlugin
from sweep.plugins.declared import PluginSetting

DEFAULT_CALLS = 400
TIME_LIMIT_S = 60.0

MAX_GROWTH_BYTES_A_CALL = 1024
"""Growth of memory that is reported. An image of 640 x 480 px has 300 times as much."""

MIN_GROWTH_BYTES = 2 << 20
"""Growth below which memory is not said to grow: allocators keep some."""

FEWEST_SHARE = 0.75
"""Share of the scenes in which a detector must find the marker: all are large and sharp."""

LARGE_FAMILY = 20_000
"""Dictionaries of more IDs are tried only if asked for: AprilTag takes seconds and gigabytes to
prepare them."""

PREFERRED = "DICT_APRILTAG_36h11"


class Verdict(StrEnum):
    """What a finding means."""

    conforms = "ok"
    note = "note"
    fault = "fault"


@dataclass(frozen=True)
class Finding:
    """One line of the result."""

    check: str
    verdict: Verdict
    text: str


@dataclass
class ConformanceReport:
    """The result of a conformance test.

    Attributes
    ----------
    detector, dictionary
        What was tried, on which markers.
    versions
        Distributions that the detector is made of, with versions.
    findings
        In the order of the checks.
    detected, scenes
        Scenes in which the marker was found, and all.
    offset_px, rms_px, milliseconds
        Mean offset of corners in x and y; their RMS distance after it; median time of a search.
    """

    detector: str
    dictionary: str
    versions: dict[str, str]
    findings: list[Finding] = field(default_factory=list)
    detected: int = 0
    scenes: int = SCENES
    offset_px: tuple[float, float] | None = None
    rms_px: float | None = None
    milliseconds: float | None = None

    @property
    def conforms(self) -> bool:
        """Whether there is no fault."""
        return all(finding.verdict is not Verdict.fault for finding in self.findings)

    def add(self, check: str, verdict: Verdict, text: str) -> None:
        """Append a finding."""
        self.findings.append(Finding(check, verdict, text))


def check_detector(
    detector: str, dictionary: str | None = None, settings: Sequence[str] = (), *,
    folder: str = ".", calls: int = DEFAULT_CALLS, time_limit_s: float = TIME_LIMIT_S,
) -> ConformanceReport:
    """Try a detector on 32 noise-free scenes, and on images that it may not expect.

    Parameters
    ----------
    detector
        ``opencv``, the name of an installed plug-in, or ``module:name`` of a file in ``folder``.
    dictionary
        Of the markers; None for DICT_APRILTAG_36h11, or the first that the detector has.
    settings
        "key=value" with TOML values, as ``--set`` takes them.
    calls
        Searches over which memory is watched.
    time_limit_s
        A step that takes longer is ended: making a detector and searching all scenes is one.

    Raises
    ------
    ArgumentError, PipelineError
        If there is no such detector, dictionary or setting.
    """
    if calls < 0:
        raise ArgumentError("calls", calls, "expected at least 0")
    if not 0 < time_limit_s < float("inf"):
        raise ArgumentError("time_limit_s", time_limit_s, "expected seconds above 0")
    name = PARAMETERS["detector"].declaration.choice(detector) or detector.strip()
    chosen, known = _dictionary(name, dictionary, folder)
    pipeline = trial_pipeline(name, chosen, settings, folder)
    setting = detector_settings(pipeline)[0]
    record = setting.record() if isinstance(setting, PluginSetting) else None
    versions = dict(setting.plugin.versions) if isinstance(setting, PluginSetting) else {}
    report = ConformanceReport(name, chosen, versions)
    try:
        with Child("sweep.conformance.trial") as child:
            _Trial(report, record, child, time_limit_s).run(settings, folder, calls, known)
    except _EndedError:
        pass
    return report


def _dictionary(
    name: str, wanted: str | None, folder: str
) -> tuple[str, tuple[str, ...]]:
    """Return the dictionary to try, and all that the detector declares (none if it has all)."""
    known: tuple[str, ...] = ()
    if name != OPENCV:
        from sweep.errors import PluginError  # noqa: PLC0415
        from sweep.plugins.declared import declare  # noqa: PLC0415

        try:
            known = declare("detector", name, folder).dictionaries
        except PluginError as error:
            raise PipelineError([f"detector {name}: expected {error}"]) from None
    if wanted is not None:
        return wanted, known
    if not known or PREFERRED in known:
        return PREFERRED, known
    return next((each for each in known if missing_package(each) is None), known[0]), known


class _EndedError(Exception):
    """The child process ended; nothing more can be tried."""


class _Trial:
    """The checks of one detector, in turn."""

    def __init__(
        self, report: ConformanceReport, record: DetectorPlugin | None, child: Child,
        time_limit_s: float,
    ) -> None:
        self._report, self._record = report, record
        self._child, self._limit_s = child, time_limit_s

    def run(
        self, settings: Sequence[str], folder: str, calls: int, known: Sequence[str]
    ) -> None:
        report = self._report
        opened = self._call(
            "the scenes", trial.open_trial, report.detector, report.dictionary, tuple(settings),
            folder,
        )
        searched = self._call("32 scenes", trial.search_scenes, range(SCENES))
        self._returned(searched, opened)
        self._behaviour(searched)
        if report.detected:
            self._history(searched)
        self._odd_images()
        self._memory(calls)
        self._families(known)

    def _call(self, what: str, function: Callable[..., Any], *arguments: Any) -> Any:
        """Call a function in the child; a fault of the child is a finding, and the last."""
        try:
            return self._child.call(function, *arguments, limit_s=self._limit_s)
        except ChildDiedError as death:
            if death.timed_out:
                text = f"did not return within {self._limit_s:g} s while it searched {what}"
                self._report.add("returns", Verdict.fault, text)
            else:
                text = f"ended its process ({death}) while it searched {what}"
                self._report.add("survives", Verdict.fault, text)
            raise _EndedError from None
        except ChildRaisedError as error:
            text = f"raised while it searched {what}: {last_line(error)}"
            self._report.add("returns", Verdict.fault, text)
            raise _EndedError from None
        except MachineFaultError:
            raise
        except SweepError as error:
            self._report.add("returns", Verdict.fault, str(error))
            raise _EndedError from None

    def _returned(self, searched: trial.Searched, opened: trial.Opened) -> None:
        """Judge what was returned: faults of the returned values, IDs, order, offset."""
        report = self._report
        for fault in searched.faults:
            report.add("returns", Verdict.fault, fault)
        result = conventions(searched.found, opened.marker_id, opened.corners_px)
        if result is None:
            if not searched.faults:
                report.add(
                    "detects", Verdict.fault, f"found no marker of {report.dictionary} in "
                    f"{report.scenes} scenes with sides of 60 to 150 px",
                )
            return
        self._detected(result)
        declared = None if self._record is None else self._record.corner_order
        center = None if self._record is None else self._record.pixel_center
        lines = order_faults(result, declared, center)
        known = [] if self._record is not None else offset_fault(result, None)
        for line in lines:
            if line in known:
                report.add(
                    "conventions", Verdict.note,
                    f"{line}: OpenCV's own, which stays in its results",
                )
            else:
                report.add("conventions", Verdict.fault, line)
        if not lines:
            report.add(
                "conventions", Verdict.conforms, "IDs, order of corners, no offset above "
                "0.02 px and 4 standard errors",
            )

    def _detected(self, result: Conventions) -> None:
        report = self._report
        report.detected = result.detected
        report.offset_px = (float(result.offset_px[0]), float(result.offset_px[1]))
        report.rms_px = result.rms_px
        missed = report.scenes - result.detected
        enough = result.detected >= FEWEST_SHARE * report.scenes
        if missed:
            report.add(
                "detects", Verdict.note if enough else Verdict.fault,
                f"missed {missed} of {report.scenes} scenes with sides of 60 to 150 px",
            )
        else:
            report.add("detects", Verdict.conforms, f"all {report.scenes} scenes")

    def _behaviour(self, searched: trial.Searched) -> None:
        """Judge time, output, threads and processes."""
        report = self._report
        report.milliseconds = 1e3 * statistics.median(searched.seconds)
        declared = 1 if self._record is None else self._record.threads
        # A pool of one thread works while its caller waits.
        used = max(1, searched.threads)
        if used > declared or searched.cpu_share > declared + 0.5:
            report.add(
                "threads", Verdict.fault,
                f"starts {searched.threads} threads, {searched.cpu_share:.1f} processors busy; it "
                f"declares {declared}: a run has a process a processor",
            )
        else:
            report.add("threads", Verdict.conforms, f"{declared}, as declared")
        if searched.processes:
            report.add("processes", Verdict.fault, f"leaves {searched.processes} processes running")
        if searched.printed.strip():
            line = searched.printed.strip().splitlines()[0]
            report.add("prints", Verdict.note, f"prints: {line[:80]!r}; runs discard it")

    def _history(self, first: trial.Searched) -> None:
        """Search in reverse, after images of noise: results must be the same bits."""
        for index in (2, 4):
            self._call(trial.ODD_IMAGES[index][2], trial.search_odd_image, index)
        second = self._call("the scenes in reverse", trial.search_scenes, range(SCENES)[::-1])
        different, moved = [], 0.0
        for one, other in zip(first.found, second.found, strict=True):
            same = [number for number, _ in one] == [number for number, _ in other]
            if same and one:
                moved = max(moved, *(
                    float(np.abs(a - b).max()) for (_, a), (_, b) in zip(one, other, strict=True)
                ))
            different.append(not same or any(
                (a != b).any() for (_, a), (_, b) in zip(one, other, strict=True)
            ))
        if any(different):
            far = f"corners moved by up to {moved:.2g} px" if moved else "other markers"
            self._report.add(
                "history", Verdict.fault, f"results depend on what was searched before: "
                f"{sum(different)} of {SCENES} scenes differ in reverse order ({far})",
            )
        else:
            self._report.add("history", Verdict.conforms, "the same bits in reverse order")

    def _odd_images(self) -> None:
        raised = 0
        for index, (_, _, what) in enumerate(trial.ODD_IMAGES):
            line = self._call(what, trial.search_odd_image, index)
            if line:
                raised += 1
                self._report.add("odd images", Verdict.note, f"{what}: {line}")
        if not raised:
            self._report.add(
                "odd images", Verdict.conforms, "plain, black, noise, down to 8 x 8 px"
            )

    def _memory(self, calls: int) -> None:
        """Search many times: the second half of the calls must not take more memory."""
        if calls < 2:
            return
        for begin, count in self._portions(calls // 2):
            self._call(f"{begin + count} images", trial.search_again, count)
        before = after = 0
        for index, (begin, count) in enumerate(self._portions(calls - calls // 2)):
            start, after = self._call(f"{begin + count} images more", trial.search_again, count)
            before = before if index else start
        grown = after - before
        each = grown / (calls - calls // 2)
        if grown > MIN_GROWTH_BYTES and each > MAX_GROWTH_BYTES_A_CALL:
            self._report.add(
                "memory", Verdict.fault, f"grows by {each / 1024:.1f} KiB a call over {calls:,}"
            )
        else:
            self._report.add("memory", Verdict.conforms, f"does not grow over {calls:,} calls")

    def _portions(self, calls: int) -> Iterator[tuple[int, int]]:
        """Cut calls so that each portion fits in the time limit."""
        each_s = max((self._report.milliseconds or 1.0) * 1e-3, 1e-4)
        size = max(1, int(0.2 * self._limit_s / each_s))
        for begin in range(0, calls, size):
            yield begin, min(size, calls - begin)

    def _families(self, known: Sequence[str]) -> None:
        """Search markers of every other dictionary that is declared, in the same process."""
        report = self._report
        others = [each for each in known if each != report.dictionary]
        large = [each for each in others if marker_count(each) > LARGE_FAMILY]
        lacking = [each for each in others if missing_package(each) is not None]
        tried = [each for each in others if each not in large and each not in lacking]
        wrong = 0
        for dictionary in tried:
            opened, found = self._call(
                f"markers of {dictionary}", trial.search_family, dictionary
            )
            ids = [[number for number, _ in markers] for markers in found]
            if not any(ids):
                wrong += 1
                report.add("families", Verdict.note, f"found no marker of {dictionary}")
                continue
            result = conventions(found, opened.marker_id, opened.corners_px)
            if result is None:
                continue
            lines = [] if result.order == (0, 1, 2, 3) and not result.ids else order_faults(
                result, None if self._record is None else self._record.corner_order, None
            )
            for line in lines:
                wrong += 1
                report.add("families", Verdict.fault, f"{dictionary}: {line}")
        if tried and not wrong:
            report.add("families", Verdict.conforms, f"{', '.join(tried)} in the same process")
        if large:
            report.add(
                "families", Verdict.note, f"not tried, since they are large: {', '.join(large)}"
            )
        if lacking:
            report.add("families", Verdict.note, f"cannot be drawn here: {', '.join(lacking)}")
