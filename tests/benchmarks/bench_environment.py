"""What the way to another Python costs: the same searches in process, and in a process beside it.

python tests/benchmarks/bench_environment.py [PYTHON]   (default: this one, so that OpenCV is equal)

640 x 480 px, noise 2, sides of 15 to 120 px; 11 rounds in which both take turns. Seconds are the
processor's, of both processes together, and the clock's, which on a busy machine are others' too.
Exits with status 1 if a search takes the processor more than 15 % longer there.
"""

import sys
import time

import numpy as np
import psutil

from sweep.environments.identity import process_of
from sweep.environments.interpreters import find_python
from sweep.evaluation.foreign_search import ForeignSearch
from sweep.evaluation.opencv_threads import single_threaded
from sweep.evaluation.search import search, visibility_flags, whole_frames
from sweep.measure.detectors import make_detector
from sweep.model.scene import build_scenes
from sweep.plan.experiment import Pipeline
from sweep.plan.grid import detector_settings, scene_values

TEXT = """
[pose]
tilt_deg = {{ uniform = [0, 60] }}
azimuth_deg = {{ uniform = [0, 360] }}
jitter_px = 0.5
[scene]
noise_grey = 2
window = "{window}"
[detector]
cornerRefinementMethod = "{refinement}"
[marker]
dictionary = "{dictionary}"
[axes]
side_px = [15, 30, 60, 120]
trial = {count}
environment = ["installed", "{python}"]
"""
ROUNDS = 11
LIMIT = 1.15


@single_threaded()
def measured(window, refinement, dictionary, python):
    """Return ms a search in process, and how many times that there: of the processor, the clock."""
    pipeline = Pipeline.from_text(TEXT.format(
        window=window, refinement=refinement, dictionary=dictionary, python=python,
        count=100 if window == "auto" else 13))
    indices = [index.ravel() for index in np.indices([len(axis) for axis in pipeline.axes[:2]])]
    values = scene_values(pipeline, indices)
    count = len(indices[0])
    scenes = build_scenes(values, count)
    wanted = (visibility_flags(scenes) == 0)[:, None]
    here, there = detector_settings(pipeline)
    (searched,), _, _ = search(scenes, wanted, [here], whole_frames(values, count), [], keep=True)
    images, sides = searched.images, scenes.frame.max(axis=1).tolist()
    find_here, find_there = make_detector(here), make_detector(there)
    other = psutil.Process(process_of(find_python(python, ".")).process_id)

    def in_process():
        for row, image in images.items():
            find_here(image, scenes.dictionary[row], sides[row])

    def elsewhere():
        foreign = ForeignSearch(
            find_there, 0, scenes.dictionary, sides, [0.0] * count, [], [], [], [])
        for row, image in images.items():
            foreign.add(row, image)
        foreign.search()

    clock, cpu = np.zeros((ROUNDS, 2)), np.zeros(2)
    elsewhere()
    for turn in range(ROUNDS):
        for k, part in enumerate((in_process, elsewhere)):
            child, own, begun = other.cpu_times(), time.process_time(), time.perf_counter()
            part()
            clock[turn, k] = time.perf_counter() - begun
            ended = other.cpu_times()
            cpu[k] += time.process_time() - own
            cpu[k] += ended.user + ended.system - child.user - child.system
    return (
        1e3 * cpu[0] / ROUNDS / len(images), cpu[1] / cpu[0], np.median(clock[:, 1] / clock[:, 0]),
    )


def main():
    python = sys.argv[1] if len(sys.argv) > 1 else sys.executable
    worst = 0.0
    print("window  refinement  dictionary             here, ms   there / here: processor   clock")
    for window in ("auto", "full"):
        for refinement, dictionary in (
            ("none", "DICT_5X5_50"), ("subpix", "DICT_5X5_50"), ("apriltag", "DICT_5X5_50"),
            ("subpix", "DICT_APRILTAG_36h11"),
        ):
            ms, cpu, clock = measured(window, refinement, dictionary, python)
            worst = max(worst, cpu)
            print(f"{window:7} {refinement:11} {dictionary:20} {ms:10.3f} {cpu:25.3f} {clock:7.3f}",
                  flush=True)
    print(f"largest: {worst:.3f}")
    return int(worst > LIMIT)


if __name__ == "__main__":
    sys.exit(main())
