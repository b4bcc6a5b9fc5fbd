"""Small datasets of poses and their analysis by plain NumPy and SciPy's distributions."""

import itertools
import math

import numpy as np
import tomlkit
import xarray as xr
from scipy import special

from sweep.analysis.estimator import wilson
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped

VALUES = {
    "dictionary": ["DICT_4X4_50", "DICT_6X6_50"],
    "marker_id": [3, 7, 11, 20, 31],
    "tilt_deg": [0.0, 30.0, 60.0, 75.0],
    "side_px": [12.0, 20.0, 35.0, 60.0, 100.0, 150.0],
    "distance_m": [0.2, 0.4, 0.8, 1.6],
    "noise_grey": [1.0, 4.0],
    "trial": list(range(200)),
    "cornerRefinementMethod": ["none", "subpix", "contour", "apriltag"],
    "solver": ["ippe", "iterative", "sqpnp"],
}
GEOMETRY = ("dictionary", "marker_id", "tilt_deg", "side_px", "distance_m")
OF_DETECTION, OF_ESTIMATION = ("cornerRefinementMethod",), ("solver",)
INNER = ("xyz", "pose_parameter", "corner", "xy")
"""Dimensions of the values of one pose."""

ALL = {"dictionary": 2, "marker_id": 2, "tilt_deg": 2, "side_px": 2, "noise_grey": 2, "trial": 3,
       "cornerRefinementMethod": 2, "solver": 2}
PLAIN = {"trial": 12, "distance_m": 3, "marker_id": 4}
DRAWS = {"marker_id": 2, "tilt_deg": 2, "trial": 200}


def coordinates_of(sizes):
    """Return the values of axes of these sizes; the first of each, or more of the same kind."""
    found = {}
    for name, size in sizes.items():
        listed = VALUES.get(name, [])
        found[name] = listed[:size] if size <= len(listed) else list(range(size))
    return found


def pipeline_text(sizes, seed=1):
    """Return the text of a pipeline with axes of these sizes."""
    axes = coordinates_of({name: size for name, size in sizes.items() if name != "regime"})
    if "trial" in axes:
        axes["trial"] = sizes["trial"]
    return tomlkit.dumps({
        "seed": seed,
        "camera": {"width_px": 640, "height_px": 480, "sensor_width_mm": 4.8,
                   "sensor_height_mm": 3.6, "focal_length_mm": 4.0},
        "marker": {"size_m": 0.04} | (
            {} if "dictionary" in axes else {"dictionary": "DICT_5X5_50"}),
        "pose": {"jitter_px": 0.5} | (
            {} if {"side_px", "distance_m"} & {*axes} else {"distance_m": 0.5}),
        "axes": axes,
    })


def perfect(rng, sizes, *, rotation=None, position=None):
    """Return a dataset of poses that are all solved; errors (..., xyz) in radians and metres."""
    scene, detected, estimated = (
        tuple(name for name in sizes if name not in left_out)
        for left_out in (OF_DETECTION + OF_ESTIMATION, OF_ESTIMATION, ())
    )
    shapes = {dims: tuple(sizes[name] for name in dims) for dims in (scene, detected, estimated)}
    depth = rng.uniform(0.5, 2.0, shapes[scene])
    truth = np.stack([0.1 * depth, 0.2 * depth, depth], axis=-1)
    if rotation is None:
        rotation = rng.normal([0.004, -0.002, 0.003], 0.01, (*shapes[estimated], 3))
    if position is None:
        position = rng.normal([0.001, 0.002, 0.008], [0.002, 0.001, 0.01], rotation.shape)
    rotation = np.asarray(rotation, dtype=np.float32)
    size = np.linalg.norm(rotation.astype(np.float64), axis=-1)

    def flags(dims, value):
        return dims, np.full(shapes[dims], value, dtype=np.uint8)

    return xr.Dataset(
        {
            "true_rvec": ((*scene, "xyz"), rng.normal(size=truth.shape)),
            "true_tvec_m": ((*scene, "xyz"), truth),
            "marker_area_px": (scene, rng.uniform(100, 1000, shapes[scene])),
            "detection": flags(detected, DetectionStatus.detected),
            "estimate": flags(estimated, EstimateStatus.solved),
            "flipped": flags(estimated, Flipped.not_flipped),
            "rotation_error_rad": ((*estimated, "xyz"), rotation),
            "translation_error_m": ((*estimated, "xyz"), np.asarray(position, dtype=np.float32)),
            "rotation_error_deg": (estimated, np.degrees(size).astype(np.float32)),
        },
        coordinates_of(sizes) | {"xyz": ["x", "y", "z"]},
        {"pipeline": pipeline_text(sizes)},
    )


def with_every_flag(rng, results, *, good=0.6):
    """Return the dataset with poses that went wrong in every way the kernel knows."""
    out = results.copy(deep=True)
    shape = out["detection"].shape
    kinds = np.array(list(DetectionStatus), dtype=np.uint8)
    out["detection"].values[...] = np.where(
        rng.random(shape) < good, DetectionStatus.detected, rng.choice(kinds, shape)
    )
    seen = xr.broadcast(out["detection"], out["estimate"])[0]
    seen = seen.transpose(*out["estimate"].dims).values
    shape = seen.shape
    kinds = [
        kind
        for kind in EstimateStatus
        if kind not in (EstimateStatus.not_run, EstimateStatus.no_detection,
                        EstimateStatus.not_needed)
    ]
    estimate = np.where(rng.random(shape) < good, EstimateStatus.solved,
                        rng.choice(np.array(kinds, dtype=np.uint8), shape))
    estimate[seen != DetectionStatus.detected] = EstimateStatus.no_detection
    estimate[seen == DetectionStatus.not_run] = EstimateStatus.not_run
    estimate[seen == DetectionStatus.crashed] = EstimateStatus.crashed
    estimate[seen == DetectionStatus.not_needed] = EstimateStatus.not_needed
    solved = estimate == EstimateStatus.solved
    out["estimate"].values[...] = estimate
    out["flipped"].values[...] = np.where(
        solved, np.where(rng.random(shape) < 0.2, Flipped.flipped, Flipped.not_flipped),
        np.where(estimate == EstimateStatus.not_run, Flipped.not_run, Flipped.no_estimate),
    )
    kept = solved | (estimate == EstimateStatus.not_explained)  # its pose is kept beside the flag
    for name in ("rotation_error_rad", "translation_error_m", "rotation_error_deg"):
        errors = out[name].values
        errors[~kept] = np.nan
        errors[estimate == EstimateStatus.not_explained] *= 50
    nothing = (seen == DetectionStatus.not_run).all(
        axis=tuple(k for k, name in enumerate(out["estimate"].dims)
                   if name in OF_DETECTION + OF_ESTIMATION))
    out["true_tvec_m"].values[nothing] = np.nan
    out["marker_area_px"].values[nothing] = np.nan
    return out


def mixed(sizes, seed=1, **options):
    rng = np.random.default_rng(seed)
    return with_every_flag(rng, perfect(rng, sizes), **options)


def with_detected(results, hits):
    """Return the dataset with poses detected where ``hits``, and solved where detected."""
    out = results.copy(deep=True)
    dims = results["detection"].dims
    detected = xr.DataArray(np.broadcast_to(hits, results["detection"].shape), dims=dims)
    out["detection"] = (
        dims,
        np.where(detected, DetectionStatus.detected, DetectionStatus.no_candidate).astype(np.uint8),
    )
    estimated = results["estimate"]
    seen = xr.broadcast(detected, estimated.drop_vars(estimated.coords))[0]
    seen = seen.transpose(*estimated.dims)
    for name, yes, no in (("estimate", EstimateStatus.solved, EstimateStatus.no_detection),
                          ("flipped", Flipped.not_flipped, Flipped.no_estimate)):
        out[name] = (seen.dims, np.where(seen, yes, no).astype(np.uint8))
    for name in ("rotation_error_rad", "translation_error_m", "rotation_error_deg"):
        out[name] = out[name].where(seen)
    return out


class Poses:
    """N poses: the values (N, ...) of variables by name, numbers (N,) of their cells and draws."""

    def __init__(self, values, cell, unit):
        self.values, self.cell, self.unit = values, cell, unit

    def __getitem__(self, name):
        return self.values[name]

    def __len__(self):
        return len(self.cell)

    def where(self, mask):
        """Return the poses of a mask (N,)."""
        return Poses({name: array[mask] for name, array in self.values.items()},
                     self.cell[mask], self.unit[mask])


def poses(results, of, per=(), bins=None):
    """Return {kept indices: poses}; ``of`` is the variable that says which dimensions one has."""
    bins = bins or {}
    axes = [name for name in results[of].dims if name not in INNER]
    axes += [name for name in per if name not in axes]
    shape = [results.sizes[name] for name in axes]
    values = {}
    for name, variable in results.variables.items():
        if set(variable.dims) <= {*axes, *INNER} and name not in INNER:
            sizes = dict(zip(axes, shape, strict=True)) | variable.sizes
            wide = variable.set_dims(sizes).transpose(*axes, ...)
            values[name] = wide.values.reshape(-1, *wide.shape[len(axes):])
    at = dict(zip(axes, np.indices(shape).reshape(len(axes), -1), strict=True))
    cell, draw = np.zeros((2, math.prod(shape)), dtype=int)
    for name in axes:
        if name in GEOMETRY and name not in per:
            cell = cell * results.sizes[name] + at[name]
    if "trial" in axes and "trial" not in per:
        draw = at["trial"]
    whole = Poses(values, cell, cell * 1000 + draw)
    places = [at[name] for name in per]
    places += [np.digitize(values[name], edges) - 1 for name, edges in bins.items()]
    counts = [results.sizes[name] for name in per] + [len(edges) - 1 for edges in bins.values()]
    return {
        index: whole.where(np.logical_and.reduce([np.ones(len(whole), bool), *(
            place == k for place, k in zip(places, index, strict=True))]))
        for index in itertools.product(*map(range, counts))}


def looked_for(some):
    return ~np.isin(some["detection"], [
        DetectionStatus.not_run, DetectionStatus.not_visible, DetectionStatus.not_modelled,
        DetectionStatus.not_needed, DetectionStatus.not_in_photograph,
        DetectionStatus.not_on_board])


def is_run(some):
    return ~np.isin(some["detection"], [DetectionStatus.not_run, DetectionStatus.not_needed])


def is_detected(some):
    return some["detection"] == DetectionStatus.detected


def is_solved(some):
    return some["estimate"] == EstimateStatus.solved


def is_unflipped(some):
    return is_solved(some) & (some["flipped"] == Flipped.not_flipped)


def degrees(some):
    return np.degrees(some["rotation_error_rad"].astype(np.float64))


def percent(some):
    errors = some["translation_error_m"][:, 2].astype(np.float64)
    return (100.0 * errors / some["true_tvec_m"][:, 2])[:, None]


def metres(some):
    return some["translation_error_m"].astype(np.float64)


QUANTITIES = {"rotation": ("deg", degrees), "range": ("percent", percent),
              "position": ("m", metres)}
"""Quantity -> unit, and the errors (N, ...) of poses."""
SHARES = {"median": 50, "p95": 95, "p99": 99}


def lengths_of(vectors):
    return np.linalg.norm(vectors, axis=1)


def draws_in(some):
    """Return what poses are worth in draws, Kish's effective number; their number if m is equal."""
    sizes = np.unique(some.unit, return_counts=True)[1]
    return int(sizes.sum() ** 2 // max(1, (sizes**2).sum()))


def freedom_in(some):
    """Return the number of draws beyond the first of each cell; 0: nothing was drawn."""
    return len(np.unique(some.unit)) - len(np.unique(some.cell))


def rate(name, of, hits):
    """Return a rate and its interval, the successes scaled outwards to draws."""
    n, draws, hits = len(of), draws_in(of), int(hits)
    out = {name: hits / n if n else math.nan}
    if freedom_in(of) == 0:
        return out | {f"{name}_low": math.nan, f"{name}_high": math.nan}
    return out | {f"{name}_low": wilson(hits * draws // n, draws)[0],
                  f"{name}_high": wilson(math.ceil(hits * draws / n), draws)[1]}


def mean_of(used, values, run):
    """Return mean, standard error and degrees of freedom of the values (N,) of used poses.

    ``run`` are the poses whose draws make the sample: Cochran 1977, sections 6.11 and 5A.14.
    """
    n = len(used)
    if n == 0:
        return math.nan, math.nan, math.nan
    mean = math.fsum(values) / n
    most = freedom_in(used)
    if most == 0:
        return mean, math.nan, math.nan
    sums = np.bincount(used.unit, values - mean, minlength=run.unit.max() + 1)
    terms, m2, freedom, alone = [], 0.0, 0, 0
    for cell in np.unique(run.cell):
        of_cell = sums[np.unique(run.unit[run.cell == cell])]
        if len(of_cell) == 1:
            alone += 1
            continue
        terms.append((len(of_cell) * np.var(of_cell, ddof=1), len(of_cell) - 1))
        m2 += np.var(of_cell) * len(of_cell)
        freedom += len(of_cell) - 1
    spread = math.fsum(term for term, _ in terms)
    weighed = math.fsum(term**2 / (f + 2) for term, f in terms)
    welch = spread**2 / weighed - 2 if weighed else math.inf
    return mean, math.sqrt(spread + alone * m2 / freedom) / n, min(welch, most)


def students(freedom):
    return special.stdtrit(freedom, 0.975)  # what stats.t.ppf is, without its checks


def student(mean, error, freedom):
    half = error * students(freedom)
    return mean, mean - half, mean + half


def exponential(mean, error, freedom):
    """Student's interval of the logarithm, by the delta method."""
    if mean == 0 or math.isnan(error):
        return student(mean, error, freedom)
    with np.errstate(over="ignore"):
        factor = np.exp(error / mean * students(freedom))
    return mean, mean / factor, mean * factor


def root_mean_square(used, vectors, run):
    """Return the RMS of the vectors (N, ...) of used poses.

    The share of draws that none showed is below 1 - 0.025^(1/n); they are as the largest that was
    seen.
    """
    squares = lengths_of(vectors) ** 2
    mean, low, high = exponential(*mean_of(used, squares, run))
    if not math.isnan(high):
        of_draw = np.bincount(used.unit, squares)[np.unique(used.unit)]
        largest = (of_draw / np.unique(used.unit, return_counts=True)[1]).max()
        unseen = 1 - 0.025 ** (1 / (freedom_in(used) + 1))
        high = max(high, (1 - unseen) * high + unseen * largest)
    return math.sqrt(mean), math.sqrt(low), math.sqrt(high)


def mean_vector(vectors):
    return np.array([math.fsum(part) / len(vectors) for part in vectors.T])


def spread(used, vectors, run):
    """Return the standard deviation about the mean vector, with n - 1."""
    if len(used) < 2:
        return math.nan, math.nan, math.nan
    factor = math.sqrt(len(used) / (len(used) - 1))
    around = vectors - mean_vector(vectors)
    return tuple(factor * end for end in root_mean_square(used, around, run))


def named(name, interval):
    return dict(zip((name, f"{name}_low", f"{name}_high"), interval, strict=True))


def tolerance(name):
    """Return the relative tolerance of a variable: store values are rounded to float32."""
    if any(f"_{label}_" in name for label in SHARES):
        return 2e-7
    return 1e-9 if name.split()[0].endswith(("_low", "_high")) else 1e-12


def assert_values(found, expected, where):
    wrong = []
    for name, value in expected.items():
        number = found[name].item()
        if isinstance(value, int):
            assert found[name].dtype.kind in "iu", name
            right = number == value
        else:
            right = (number == value or (math.isnan(value) and math.isnan(number))
                     or abs(number - value) <= tolerance(name) * abs(value) + 1e-14)
        if not right:
            wrong.append(f"{name}: {number!r}, expected {value!r}")
    assert not wrong, f"{where}: " + "; ".join(wrong)


def assert_agrees(told, at, expected):
    here = told.isel(at)
    assert_values({name: here[name].values for name in expected}, expected, at)


def holm(p_values):
    """Holm 1979: the smallest times m, the next times m - 1, ..., never falling."""
    adjusted, largest = {}, 0.0
    for k, index in enumerate(sorted(range(len(p_values)), key=lambda i: p_values[i])):
        largest = max(largest, (len(p_values) - k) * p_values[index])
        adjusted[index] = min(1.0, largest)
    return [adjusted[index] for index in range(len(p_values))]


GRIDS = {
    "all": mixed(ALL),
    "plain": mixed(PLAIN, 2),
    "draws": mixed(DRAWS, 3, good=0.97),
    "no trial": mixed({"marker_id": 3, "side_px": 3, "cornerRefinementMethod": 2}, 4),
    "one trial": mixed({"trial": 1, "tilt_deg": 3}, 5),
    "only trial": mixed({"trial": 60}, 6),
    "small": mixed({name: 1 if name in ("dictionary", "marker_id") else 2 for name in ALL}, 10),
    "settings first": mixed(
        {"solver": 2, "trial": 5, "cornerRefinementMethod": 2, "distance_m": 3}, 7),
}
