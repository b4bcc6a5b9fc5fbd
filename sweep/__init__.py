"""How well will I know the pose? Experiments with fiducial markers, against the truth.

The signature of a public function has all that it takes. Its example runs: ``folder`` is the path
of an empty folder, and for `photos`, `fit`, `twins` and `compare` it has three photographs of a
ChArUco board in ``shots``, the calibration ``camera.json`` and the board's file ``board.toml``.
Stores that one example makes are read by others. Lengths are in metres, pixels (``_px``) or
millimetres (``_mm``), angles in degrees (``_deg``) or radians (``_rad``), as the names say.

Importing this package is quick: NumPy, Numba, Dask and xarray are imported when a function needs
them.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Unpack

from sweep import experiment, library
from sweep.errors import (
    ArgumentError,
    DatasetError,
    PipelineError,
    RunError,
    StoreError,
    SweepError,
    path_of,
)
from sweep.execution.progress import DEFAULTS, Progress, RunOptions, taking_run_options
from sweep.isolation.child_process import Child
from sweep.messages import notice
from sweep.version import __version__

if TYPE_CHECKING:
    import xarray as xr

    from sweep.analysis.dataset import decode_flags
    from sweep.cli.reference import reference
    from sweep.diagnosis.detection import error_model
    from sweep.diagnosis.diagnosis import diagnose
    from sweep.experiment.pipeline import Pipeline
    from sweep.fitting.fit import fit
    from sweep.report.findings import limit, measure_tradeoff, require, size
    from sweep.report.table import Findings
    from sweep.report.write_report import write_report

__all__ = [
    "ArgumentError", "DatasetError", "Pipeline", "PipelineError", "Progress", "RunError",
    "StoreError", "SweepError", "__version__", "compare", "decode_flags", "diagnose",
    "error_model", "fit", "limit", "measure_tradeoff", "open", "photos", "reference", "require",
    "run", "size", "twins", "write_report",
]

experiment.quantity_faults = lambda texts, names: (  # noqa: PLW0108  (imported when it is used)
    library.requirements.quantity_faults(texts, names))

#: Modules of the library that have public names, but for those of `findings`.
_HOMES = {
    "Pipeline": "pipeline", "decode_flags": "dataset", "diagnose": "diagnosis",
    "error_model": "detection", "fit": "fit", "reference": "reference",
    "write_report": "write_report",
}


if not TYPE_CHECKING:  # so that mypy knows the names above alone

    def __getattr__(name: str) -> Any:
        """Import a public name when it is first used."""
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(getattr(library, _HOMES.get(name, "findings")), name)


def __dir__() -> list[str]:
    return sorted(__all__)


@taking_run_options
def run(
    pipeline: Pipeline | Mapping[str, Any] | str | os.PathLike[str],
    *,
    store: str | os.PathLike[str] | None = None,
    **options: Unpack[RunOptions],
) -> xr.Dataset:
    """Run a pipeline into a store and return its results.

    A finished store is opened, an unfinished one is continued. A script needs no
    ``if __name__ == "__main__":`` for it: the workers that it starts do not import the script. (A
    ``LocalCluster`` of your own does.)

    Parameters
    ----------
    pipeline
        A `Pipeline`, the path of a TOML file, a mapping with the content of such a file, or the
        path or URL of a store, which is continued with its own pipeline.
    store
        Path or URL of the store (default: ``runs/NAME.zarr`` with the pipeline's name).
    workers
        Processes of this machine (default: the available processors, or one where little work is
        expected).
    client
        A ``distributed.Client``, or a cluster object such as ``LocalCluster`` or ``SLURMCluster``,
        to run on instead. It stays open. Its workers must be processes that have the same versions
        as this one and reach the store under the same path.
    scheduler
        Address of a Dask scheduler to run on instead, such as ``tcp://host:8786``; ``local`` starts
        a Dask cluster of ``workers`` processes on this machine.
    reuse
        Stores whose finished cells are copied where all their parameters agree.
    overwrite
        Delete an existing store.
    retry_failed
        Compute the blocks again in which cells failed or crashed, also of a finished store.
    yes
        Run also what is predicted to take more than a day, or more than is free on the disk; such
        a run is refused otherwise. Reused cells are not predicted, so that it is not then.
    progress
        True for a progress bar on stderr (lines if that is not a terminal), or a function that is
        called with a `Progress` after each block.
    time_limit_s
        Block timeout in seconds: a pose that does not return within it is flagged ``crashed``
        (default: 600, or ten times a block's work if that is more, as in very long runs).

    Returns
    -------
    xarray.Dataset
        The results, lazily loaded; the variables are described in their attributes. What failed,
        or that nothing was detected, is told on stderr.

    Raises
    ------
    PipelineError
        If the pipeline is not valid; it names all faults at once.
    ArgumentError
        If another argument is not valid, or the cluster cannot be used. It is a ValueError.
    StoreError
        If the store cannot be written, continued or reused.
    RunError
        If the run fails; finished blocks stay in the store, and the next run continues.

    Examples
    --------
    >>> results = sweep.run(
    ...     {"pose": {"jitter_px": 0.5}, "axes": {"side_px": [20, 40], "trial": 10}},
    ...     store=folder / "two_sizes.zarr",
    ... )
    >>> dict(results.detection.sizes)
    {'side_px': 2, 'trial': 10}
    """
    # The child imports its packages while this process does.
    with Child() as child:
        read = library.lifecycle.read_pipeline(pipeline)
        summary = library.runner.execute(
            read, library.lifecycle.store_of(pipeline, store), child=child, **options)
    notice(*summary.warnings)
    if summary.advice:
        notice(f"look at it: {summary.advice}")
    return open(summary.store)


def open(store: str | os.PathLike[str]) -> xr.Dataset:  # noqa: A001  (as xarray and zarr have it)
    """Open a store's results, lazily; also an unfinished run's.

    Parameters
    ----------
    store
        Path or URL of the store.

    Returns
    -------
    xarray.Dataset
        The results; cells that were not computed yet are flagged ``not_run``.

    Raises
    ------
    StoreError
        If there is no store, or it cannot be read.

    Examples
    --------
    >>> results = sweep.open(folder / "two_sizes.zarr")
    >>> results.side_px.values.tolist()
    [20.0, 40.0]
    """
    return library.lifecycle.open_dataset(store)


@taking_run_options
def photos(
    *folders: str | os.PathLike[str],
    camera: str | os.PathLike[str] | None = None,
    board: str | os.PathLike[str] | None = None,
    poses: str | os.PathLike[str] | None = None,
    stereo: str | os.PathLike[str] | None = None,
    settings: Sequence[str] = (),
    store: str | os.PathLike[str] | None = None,
    **options: Unpack[RunOptions],
) -> xr.Dataset:
    """Measure detectors and estimators on photographs of known markers.

    Parameters
    ----------
    folders
        A folder of photographs of one camera; with ``stereo`` two, or one of images whose halves
        are the left and the right camera's.
    camera
        The file of a calibration, or "calibrate": from the board in the photographs.
    board
        The board's TOML file. The truth of a marker is the board's pose by all other corners.
    poses
        A file of the true poses, as ``sweep score`` reads them.
    stereo
        The file of a stereo calibration: the truth is the pose in the other camera's image.
    settings
        "key=value" with TOML values, as ``--set`` takes them: ``'solver=["ippe", "sqpnp"]'``.
    store
        Path or URL of the store (default: ``runs/NAME.zarr`` with the folder's name).
    workers, client, scheduler, reuse, overwrite, retry_failed, yes, progress, time_limit_s
        As for :func:`run`.

    Returns
    -------
    xarray.Dataset
        The results, with the dimensions of a simulation's: ``trial`` is the photograph's number,
        and ``photograph`` its file. Lines on what was found are told on stderr.

    Raises
    ------
    ArgumentError, PipelineError, StoreError, RunError
        As for :func:`run`; photographs, cameras and boards that do not fit are told in a line.

    Examples
    --------
    >>> shots = sweep.photos(
    ...     folder / "shots", camera=folder / "camera.json", board=folder / "board.toml",
    ...     store=folder / "shots.zarr")
    >>> dict(shots.detection.sizes)  # photographs, and markers of the board
    {'trial': 3, 'marker_id': 10}
    """
    prepared = library.prepare.prepare(
        folders, camera, board=board, poses=poses, stereo=stereo, settings=settings, store=store,
        overwrite=options["overwrite"])
    notice(*prepared.lines)
    return run(prepared.pipeline, store=prepared.store, **options)


@taking_run_options
def twins(
    photographs: str | os.PathLike[str],
    scene: Mapping[str, Any] | str | os.PathLike[str],
    *,
    repeats: int = 1,
    store: str | os.PathLike[str] | None = None,
    **options: Unpack[RunOptions],
) -> xr.Dataset:
    """Simulate the markers of photographs at their poses.

    Parameters
    ----------
    photographs
        Path or URL of their store, as :func:`photos` makes it.
    scene
        Parameters of the section [scene], values or distributions; or a TOML file that has it.
    repeats
        How often each photograph is simulated: trial k has the poses of photograph k modulo their
        number.
    store
        Path or URL of the twins' store (default: beside the photographs', with the scene's name).
    workers, client, scheduler, reuse, overwrite, retry_failed, yes, progress, time_limit_s
        As for :func:`run`.

    Returns
    -------
    xarray.Dataset
        The results, with the photographs' rows: `sweep.analysis.simulation_gap` compares both.

    Raises
    ------
    ArgumentError, PipelineError, StoreError, RunError
        As for :func:`run`; also if the store is not of photographs.

    Examples
    --------
    >>> simulated = sweep.twins(
    ...     folder / "shots.zarr", {"blur_px": 0.6, "noise_grey": 2.0},
    ...     store=folder / "twins.zarr")
    >>> simulated.true_tvec_m.shape  # photographs, markers, and x, y, z in metres
    (3, 10, 3)
    """
    named = "twins" if isinstance(scene, Mapping) else path_of("scene", scene)
    measured = library.lifecycle.read_pipeline(photographs)
    section = scene if isinstance(scene, Mapping) else library.prepare.read_scene(named, measured)
    return run(
        library.prepare.twin_pipeline(measured, section, repeats),
        store=store or library.prepare.twin_store(photographs, named), **options)


@taking_run_options
def compare(
    first: str | os.PathLike[str],
    second: str | os.PathLike[str],
    *,
    bins: Mapping[str, Sequence[float]] | None = None,
    output: str | os.PathLike[str] | None = None,
    repeats: int = 1,
    store: str | os.PathLike[str] | None = None,
    **options: Unpack[RunOptions],
) -> Findings:
    """Compare photographs with a simulation, or two stores of one pipeline.

    Parameters
    ----------
    first
        Store of photographs, or any store.
    second
        Store of a simulation; a TOML file with a section [scene], with which the photographs'
        markers are then simulated; or another store of the first one's pipeline, such as that of
        another version of OpenCV.
    bins
        Variable of the scene -> edges of bins in which photographs and simulation are compared.
    output
        PNG or SVG file of the rates and errors of both.
    repeats, store
        As for :func:`twins`.
    workers, client, scheduler, reuse, overwrite, retry_failed, yes, progress, time_limit_s
        As for :func:`run`.

    Returns
    -------
    Findings
        What differs; ``data`` is the dataset of `sweep.analysis.simulation_gap` or
        `sweep.analysis.store_differences`.

    Raises
    ------
    ArgumentError, PipelineError, StoreError, RunError, DatasetError
        As for :func:`twins`; also for stores that are no pair.

    Examples
    --------
    >>> again = sweep.run(folder / "two_sizes.zarr", store=folder / "again.zarr")
    >>> found = sweep.compare(folder / "two_sizes.zarr", folder / "again.zarr")
    >>> int(found.data.detections_compared), int(found.data.detections_differing)
    (20, 0)
    >>> found = sweep.compare(folder / "shots.zarr", folder / "twins.zarr")
    >>> found.data.detection_rate.values.tolist()  # photographs, simulated
    [1.0, 1.0]
    """
    given = {"repeats": repeats, "store": store, **options, "progress": None}
    usual = {"repeats": 1, "store": None, **DEFAULTS}
    library.output_file.figure_file(output)
    one, other = path_of("first", first), path_of("second", second)
    library.lifecycle.open_finished(one)
    if other.endswith(".toml"):
        scene, other = other, os.fspath(store or library.prepare.twin_store(one, other))
        twins(one, scene, repeats=repeats, store=other, **options)
    elif unused := [name for name in given if given[name] not in (usual[name], [])]:
        raise ArgumentError(unused[0], given[unused[0]], "expected none: two stores need no run")
    return library.findings.compare(one, other, bins=bins or None, output=output)
