"""The analysis functions against plain loops over every pose of small datasets.

The loops follow the definitions of the functions' descriptions, and SciPy's distributions; nothing
of `sweep.analysis` is used in them.
"""

import functools
import itertools
import math
from collections import Counter

import numpy as np
import pytest
import xarray as xr
from scipy import special, stats
from statsmodels.stats import proportion

from sweep.analysis import detection_rate, error_statistics, failure_composition, flip_rate
from sweep.errors import StoreError
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped
from sweep.plan.experiment import Pipeline

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
INNER = {"xyz": ["x", "y", "z"]}

TEXT = """seed = {seed}
[camera]
width_px = 640
height_px = 480
sensor_width_mm = 4.8
sensor_height_mm = 3.6
focal_length_mm = 4.0
[marker]
size_m = 0.04
{dictionary}
[pose]
jitter_px = 0.5
{size}
[axes]
{axes}
"""
FX = 4.0 / 4.8 * 640
SIZE_M = 0.04

ALL = {"dictionary": 2, "marker_id": 2, "tilt_deg": 2, "side_px": 2, "noise_grey": 2, "trial": 3,
       "cornerRefinementMethod": 2, "solver": 2}
PLAIN = {"trial": 12, "distance_m": 3, "marker_id": 4}
DRAWS = {"marker_id": 2, "tilt_deg": 2, "trial": 200}


# Datasets.

def coordinates_of(sizes):
    """Return the values of axes of these sizes; the first of each, or more of the same kind."""
    found = {}
    for name, size in sizes.items():
        listed = VALUES.get(name, [])
        found[name] = listed[:size] if size <= len(listed) else list(range(size))
    return found


def pipeline_text(sizes, seed=1):
    """Return the text of a pipeline with axes of these sizes."""
    values = coordinates_of({name: size for name, size in sizes.items() if name != "regime"})
    axes = [f"{name} = {len(some) if name == 'trial' else list(some)!r}".replace("'", '"')
            for name, some in values.items()]
    sized = "side_px" in values or "distance_m" in values
    return TEXT.format(
        seed=seed, axes="\n".join(axes), size="" if sized else "distance_m = 0.5",
        dictionary="" if "dictionary" in values else 'dictionary = "DICT_5X5_50"',
    )


def dims_of(sizes, stage):
    """Return the axes of a stage, in order: of the scene, with detection, with estimation."""
    left_out = {"scene": OF_DETECTION + OF_ESTIMATION, "detection": OF_ESTIMATION,
                "estimation": ()}[stage]
    return tuple(name for name in sizes if name not in left_out)


def perfect(rng, sizes, *, rotation=None, position=None):
    """Return a dataset of poses that are all solved; errors (..., xyz) in radians and metres."""
    scene, detected, estimated = (
        dims_of(sizes, stage) for stage in ("scene", "detection", "estimation")
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
        coordinates_of(sizes) | INNER,
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
        if kind not in (EstimateStatus.not_run, EstimateStatus.no_detection)
    ]
    estimate = np.where(rng.random(shape) < good, EstimateStatus.solved,
                        rng.choice(np.array(kinds, dtype=np.uint8), shape))
    estimate[seen != DetectionStatus.detected] = EstimateStatus.no_detection
    estimate[seen == DetectionStatus.not_run] = EstimateStatus.not_run
    estimate[seen == DetectionStatus.crashed] = EstimateStatus.crashed
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


# Poses.

def poses(results, of, per=(), bins=None):
    """Return {kept indices: poses} by plain loops; a pose is its values, cell, draw and setting.

    ``of`` is the variable that says which dimensions a pose has.
    """
    bins = bins or {}
    axes = [name for name in results[of].dims if name not in INNER]
    axes += [name for name in per if name not in axes]
    arrays = {name: ([dim for dim in array.dims if dim not in INNER],
                     array.transpose(..., *(d for d in array.dims if d in INNER)).values)
              for name, array in results.variables.items()
              if set(array.dims) <= {*axes, *INNER} and name not in INNER}
    kept = [range(results.sizes[name]) for name in per]
    kept += [range(len(edges) - 1) for edges in bins.values()]
    groups = {index: [] for index in itertools.product(*kept)}
    for index in itertools.product(*(range(results.sizes[name]) for name in axes)):
        at = dict(zip(axes, index, strict=True))
        pose = {name: values[tuple(at[dim] for dim in dims)]
                for name, (dims, values) in arrays.items()}
        here = [at[name] for name in per]
        for name, edges in bins.items():
            here += [k for k in range(len(edges) - 1) if edges[k] <= pose[name] < edges[k + 1]]
        if len(here) < len(per) + len(bins):
            continue  # outside of the bins
        pooled = [name for name in axes if name not in per]
        pose["at"] = index
        pose["cell"] = tuple(at[name] for name in pooled if name in GEOMETRY)
        pose["draw"] = at["trial"] if "trial" in pooled else 0
        groups[tuple(here)].append(pose)
    return groups


def looked_for(pose):
    return pose["detection"] not in {
        DetectionStatus.not_run, DetectionStatus.not_visible, DetectionStatus.not_modelled
    }


def is_run(pose):
    return pose["detection"] != DetectionStatus.not_run


def is_detected(pose):
    return pose["detection"] == DetectionStatus.detected


def is_solved(pose):
    return pose["estimate"] == EstimateStatus.solved


def is_unflipped(pose):
    return is_solved(pose) and pose["flipped"] == Flipped.not_flipped


def degrees(pose):
    return np.degrees(pose["rotation_error_rad"].astype(np.float64))


def percent(pose):
    return np.array([100.0 * float(pose["translation_error_m"][2])
                     / float(pose["true_tvec_m"][2])])


def metres(pose):
    return pose["translation_error_m"].astype(np.float64)


QUANTITIES = {"rotation": ("deg", degrees), "range": ("percent", percent),
              "position": ("m", metres)}
"""Quantity -> unit, and the error as a vector."""
SHARES = {"median": 50, "p95": 95, "p99": 99}


def length(vector):
    return math.hypot(*np.asarray(vector).tolist())


# Intervals.

def draws_by_cell(found):
    """Return {cell: draws} of a list of poses."""
    cells = {}
    for pose in found:
        cells.setdefault(pose["cell"], set()).add(pose["draw"])
    return cells


def draws_in(found):
    """Return what poses are worth in draws, Kish's effective number; their number if m is equal."""
    sizes = Counter((pose["cell"], pose["draw"]) for pose in found).values()
    return sum(sizes) ** 2 // max(1, sum(size**2 for size in sizes))


def freedom_in(found):
    """Return the number of draws beyond the first of each cell; 0: nothing was drawn."""
    return sum(len(draws) - 1 for draws in draws_by_cell(found).values())


def rate(name, of, hits, method="wilson"):
    """Return a rate and its interval, the successes scaled outwards to draws."""
    n, draws = len(of), draws_in(of)
    out = {name: hits / n if n else math.nan}
    stem = name if method == "wilson" else f"{name}_{method}"
    if freedom_in(of) == 0:
        return out | {f"{stem}_low": math.nan, f"{stem}_high": math.nan}
    ends = wilson if method == "wilson" else jeffreys
    return out | {f"{stem}_low": ends(hits * draws // n, draws)[0],
                  f"{stem}_high": ends(math.ceil(hits * draws / n), draws)[1]}


@functools.cache
def wilson(successes, n):
    """Brown, Cai and DasGupta 2001, eq. 4."""
    z = stats.norm.ppf(0.975)
    p = successes / n
    centre = (successes + z**2 / 2) / (n + z**2)
    half = z * math.sqrt(n) / (n + z**2) * math.sqrt(p * (1 - p) + z**2 / (4 * n))
    return (0.0 if successes == 0 else centre - half), (1.0 if successes == n else centre + half)


@functools.cache
def jeffreys(successes, n):
    """Brown, Cai and DasGupta 2001, section 3.1.3."""
    low, high = stats.beta.ppf([0.025, 0.975], successes + 0.5, n - successes + 0.5)
    return (0.0 if successes == 0 else low), (1.0 if successes == n else high)


def mean_of(pairs, run):
    """Return mean, standard error and degrees of freedom; ``pairs`` of a used pose and its value.

    ``run`` are the poses whose draws make the sample: Cochran 1977, sections 6.11 and 5A.14.
    """
    if not pairs:
        return math.nan, math.nan, math.nan
    n = len(pairs)
    mean = math.fsum(value for _, value in pairs) / n
    most = freedom_in([pose for pose, _ in pairs])
    if most == 0:
        return mean, math.nan, math.nan
    sums = {(cell, draw): 0.0 for cell, draws in draws_by_cell(run).items() for draw in draws}
    for pose, value in pairs:
        sums[pose["cell"], pose["draw"]] += value - mean
    terms, m2, freedom, alone = [], 0.0, 0, 0
    for cell, draws in draws_by_cell(run).items():
        of_cell = np.array([sums[cell, draw] for draw in draws])
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


def root_mean_square(vectors, run):
    """Return the RMS of ``[(pose, vector)]``."""
    pairs = [(pose, length(vector) ** 2) for pose, vector in vectors]
    return tuple(math.sqrt(end) for end in exponential(*mean_of(pairs, run)))


def bias(vectors, run):
    """Return the length of the mean vector, or the signed mean of what has one component."""
    if not vectors:
        return math.nan, math.nan, math.nan
    centre = mean_vector(vectors)
    if len(centre) == 1:
        return student(*mean_of([(pose, vector[0]) for pose, vector in vectors], run))
    direction = centre / length(centre)
    along = [(pose, vector @ direction) for pose, vector in vectors]
    mean, error, freedom = mean_of(along, run)
    if math.isnan(error):
        return length(centre), math.nan, math.nan
    _, _, high = student(mean, error, freedom)
    if freedom <= 2:
        return length(centre), 0.0, high
    scheffe = math.sqrt(3 * freedom / (freedom - 2) * special.fdtri(3, freedom - 2, 0.95))
    return length(centre), max(0.0, mean - scheffe * error), high


def mean_vector(vectors):
    return np.array([math.fsum(part) / len(vectors)
                     for part in zip(*(v.tolist() for _, v in vectors), strict=True)])


def spread(vectors, run):
    """Return the standard deviation about the mean vector, with n - 1."""
    if len(vectors) < 2:
        return math.nan, math.nan, math.nan
    centre = mean_vector(vectors)
    factor = math.sqrt(len(vectors) / (len(vectors) - 1))
    around = [(pose, vector - centre) for pose, vector in vectors]
    return tuple(factor * end for end in root_mean_square(around, run))


@functools.cache
def ranks(n, p):
    """Return the ranks, from 1, between which the p-quantile lies but for 2.5 % at each end."""
    return stats.binom.ppf(0.025, n, p), stats.binom.ppf(0.975, n, p) + 1


def order_statistics(values, of, share):
    """Return a quantile and its interval: David and Nagaraja 2003, section 7.1."""
    n, draws, p = len(values), draws_in(of), share / 100
    if n == 0:
        return math.nan, math.nan, math.nan
    ordered = sorted(values)
    value = next(v for k, v in enumerate(ordered) if 100 * (k + 1) >= share * n)
    if freedom_in(of) == 0:
        return value, math.nan, math.nan
    first, last = ranks(draws, p)
    low = ordered[int(first) * n // draws - 1] if first >= 1 else math.nan
    high = ordered[math.ceil(int(last) * n / draws) - 1] if last <= draws else math.nan
    return value, low, high


def named(name, interval):
    return dict(zip((name, f"{name}_low", f"{name}_high"), interval, strict=True))


# The functions.

def expected_detection(found):
    aimed = [pose for pose in found if looked_for(pose)]
    hits = sum(map(is_detected, aimed))
    return {"looked_for": len(aimed), "detected": hits, "draws": draws_in(aimed),
            **rate("detection_rate", aimed, hits),
            **rate("detection_rate", aimed, hits, "jeffreys")}


def expected_flips(found):
    solved = [pose for pose in found if is_solved(pose)]
    hits = sum(pose["flipped"] == Flipped.flipped for pose in solved)
    return {"solved": len(solved), "flipped": hits, "draws": draws_in(solved),
            **rate("flip_rate", solved, hits), **rate("flip_rate", solved, hits, "jeffreys")}


OF_LOOKED_FOR = ("solved", "wrong_id", "rejected", "no_candidate", "solver_failed",
                 "not_converged", "not_explained", "failed", "crashed")
OUTCOMES = (*OF_LOOKED_FOR, "not_visible", "not_modelled", "not_run")


def outcome(pose):
    if is_detected(pose):
        return EstimateStatus(pose["estimate"]).name
    return DetectionStatus(pose["detection"]).name


def expected_composition(found):
    """Return {"count solved": ..., "share solved": ..., ...}."""
    aimed = [pose for pose in found if looked_for(pose)]
    out = {}
    for name in OUTCOMES:
        count = sum(outcome(pose) == name for pose in found)
        values = dict.fromkeys(("share", "share_low", "share_high"), math.nan)
        if name in OF_LOOKED_FOR:
            values = rate("share", aimed, count)
        out |= {f"{key} {name}": value for key, value in ({"count": count} | values).items()}
    return out


def by_outcome(told):
    """Return the table with a variable for each outcome."""
    assert tuple(told["outcome"].values) == OUTCOMES
    return xr.Dataset({f"{key} {name}": array.isel(outcome=k, drop=True)
                       for key, array in told.data_vars.items()
                       for k, name in enumerate(OUTCOMES)})


def expected_errors(found):
    aimed = [pose for pose in found if looked_for(pose)]
    run = [pose for pose in found if is_run(pose)]
    solved = [pose for pose in aimed if is_solved(pose)]
    out = {"looked_for": len(aimed), "solved": len(solved),
           **rate("solved_rate", aimed, len(solved))}
    for name, (unit, error) in QUANTITIES.items():
        vectors = [(pose, error(pose)) for pose in solved]
        unflipped = [(pose, vector) for pose, vector in vectors if is_unflipped(pose)]
        out |= named(f"{name}_bias_{unit}", bias(unflipped, run))
        out |= named(f"{name}_sd_{unit}", spread(unflipped, run))
        out |= named(f"{name}_rmse_{unit}", root_mean_square(vectors, run))
        out |= named(f"{name}_rmse_unflipped_{unit}", root_mean_square(unflipped, run))
        sizes = [length(error(pose)) if is_solved(pose) else math.inf for pose in aimed]
        for label, share in SHARES.items():
            interval = order_statistics(sizes, aimed, share)
            out |= named(f"{name}_{label}_{unit}", interval)
            given = 2 if freedom_in(aimed) == 0 else 3 if any(map(math.isnan, interval)) else 1
            out[f"{label}_interval"] = given if aimed else 0
    return out


# Comparison.

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


def assert_all_agree(told, groups, names, expected):
    """Compare every kept combination; ``names`` are the kept dimensions."""
    arrays = {name: array.transpose(*names).values for name, array in told.data_vars.items()}
    assert not set(next(iter(arrays.values())).shape) - {told.sizes[name] for name in names}
    for index, found in groups.items():
        here = {name: array[index] for name, array in arrays.items()}
        assert_values(here, expected(found), dict(zip(names, index, strict=True)))


GRIDS = {
    "all": mixed(ALL),
    "plain": mixed(PLAIN, 2),
    "draws": mixed(DRAWS, 3, good=0.97),
    "no trial": mixed({"marker_id": 3, "side_px": 3, "cornerRefinementMethod": 2}, 4),
    "one trial": mixed({"trial": 1, "tilt_deg": 3}, 5),
    "only trial": mixed({"trial": 60}, 6),
    "small": mixed({name: 1 if name in ("dictionary", "marker_id") else 2 for name in ALL}, 10),
    "treatments first": mixed(
        {"solver": 2, "trial": 5, "cornerRefinementMethod": 2, "distance_m": 3}, 7),
}
CASES = pytest.mark.parametrize(("grid", "per"), [
    ("all", ()), ("all", ("tilt_deg",)), ("all", ("side_px", "dictionary")),
    ("all", ("noise_grey", "cornerRefinementMethod")), ("all", ("trial",)),
    ("all", ("trial", "marker_id")), ("small", tuple(n for n in ALL if n != "solver")),
    ("plain", ()), ("plain", ("distance_m",)), ("plain", ("marker_id", "distance_m")),
    ("plain", ("trial",)), ("draws", ()), ("draws", ("marker_id",)),
    ("no trial", ()), ("no trial", ("cornerRefinementMethod",)),
    ("one trial", ()), ("one trial", ("tilt_deg",)), ("only trial", ()), ("only trial", ("trial",)),
    ("treatments first", ()), ("treatments first", ("distance_m",)),
])
ESTIMATION_CASES = pytest.mark.parametrize(("grid", "per"), [
    ("all", ("solver",)), ("all", ("tilt_deg", "solver", "noise_grey")), ("small", tuple(ALL)),
    ("treatments first", ("solver",)), ("treatments first", ("cornerRefinementMethod", "solver")),
])


@functools.cache
def poses_of(grid, of, per):
    return poses(GRIDS[grid], of, per)


@CASES
def test_detection_rates_are_those_of_plain_loops(grid, per):
    assert_all_agree(detection_rate(GRIDS[grid], per), poses_of(grid, "detection", per), per,
                     expected_detection)


@CASES
def test_flip_rates_are_those_of_plain_loops(grid, per):
    assert_all_agree(flip_rate(GRIDS[grid], per), poses_of(grid, "estimate", per), per,
                     expected_flips)


@ESTIMATION_CASES
def test_flip_rates_of_solvers_are_those_of_plain_loops(grid, per):
    test_flip_rates_are_those_of_plain_loops(grid, per)


@CASES
def test_failures_are_those_of_plain_loops(grid, per):
    results = GRIDS[grid]
    told = failure_composition(results, per).compute()
    assert set(told["count"].dims) == {*per, "outcome"}
    assert_all_agree(by_outcome(told), poses_of(grid, "estimate", per), per, expected_composition)
    total = told["share"].sum("outcome").values
    anything = told["share"].notnull().any("outcome").values
    np.testing.assert_allclose(total[anything], 1.0, rtol=1e-12)
    assert (told["count"].sum("outcome") == results["estimate"].size
            // math.prod(results.sizes[name] for name in per)).all()


@ESTIMATION_CASES
def test_failures_of_solvers_are_those_of_plain_loops(grid, per):
    test_failures_are_those_of_plain_loops(grid, per)


@CASES
def test_errors_are_those_of_plain_loops(grid, per):
    assert_all_agree(error_statistics(GRIDS[grid], per), poses_of(grid, "estimate", per), per,
                     expected_errors)


@ESTIMATION_CASES
def test_errors_of_solvers_are_those_of_plain_loops(grid, per):
    test_errors_are_those_of_plain_loops(grid, per)


FUNCTIONS = pytest.mark.parametrize(("function", "of", "expected"), [
    (detection_rate, "detection", expected_detection), (flip_rate, "estimate", expected_flips),
    (error_statistics, "estimate", expected_errors),
])


@FUNCTIONS
@pytest.mark.parametrize("grid", ["all", "treatments first"])
def test_the_order_of_dimensions_does_not_matter(function, of, expected, grid):
    results = GRIDS[grid]
    names = [name for name in results.dims if name not in INNER]
    per = (names[-1],) if names[-1] in results[of].dims else ()
    groups = poses_of(grid, of, per)
    for order in (names[::-1], names[2:] + names[:2]):
        turned = results.transpose(*order, ...)
        assert_all_agree(function(turned, per), groups, per, expected)
    inner_first = results.transpose("xyz", ..., missing_dims="ignore")
    assert_all_agree(function(inner_first, per), groups, per, expected)


EDGES = [100.0, 200.0, 450.0, 451.0, 2000.0]


@FUNCTIONS
@pytest.mark.parametrize(("grid", "per", "bins"), [
    ("all", (), {"marker_area_px": EDGES}), ("all", ("tilt_deg",), {"marker_area_px": EDGES}),
    ("draws", (), {"marker_area_px": EDGES}), ("only trial", ("trial",), {"marker_area_px": EDGES}),
    ("plain", ("marker_id",), {"distance_m": [0.3, 0.8, 1.0]}),
    ("all", (), {"side_px": [12.0, 100.0]}),
])
def test_bins_are_those_of_plain_loops(function, of, expected, grid, per, bins):
    results = GRIDS[grid]
    told = function(results, per, bins=bins)
    names = (*per, *bins)
    assert tuple(next(iter(told.values())).dims) == names
    assert_all_agree(told, poses(results, of, per, bins), names, expected)
    for name, edges in bins.items():
        np.testing.assert_allclose(told[name], (np.array(edges[1:]) + edges[:-1]) / 2)
        np.testing.assert_array_equal(told[f"{name}_low"], edges[:-1])
        np.testing.assert_array_equal(told[f"{name}_high"], edges[1:])


def test_a_value_on_an_edge_is_in_the_bin_above_and_on_the_last_in_none():
    results = mixed({"trial": 6}, 8).isel(trial=slice(6))
    results["detection"].values[...] = DetectionStatus.detected
    results["marker_area_px"].values[...] = [0.0, 1.0, 2.0, 3.0, np.nan, 2.5]
    told = detection_rate(results, bins={"marker_area_px": [1.0, 2.0, 3.0]})
    assert told["looked_for"].values.tolist() == [1, 2]


def test_a_coordinate_that_is_no_dimension_can_be_binned():
    # distance_m where side_px is the axis, as the store has it.
    results, bins = GRIDS["all"], {"distance_m": [0.0, 1.5, 3.0]}
    results = results.assign_coords(distance_m=("side_px", FX * SIZE_M / results["side_px"].values))
    groups = poses(results, "estimate", ("solver",), bins)
    assert all(groups.values())
    assert_all_agree(error_statistics(results, ("solver",), bins), groups,
                     ("solver", "distance_m"), expected_errors)


def test_failures_in_bins_are_those_of_plain_loops():
    results, bins = GRIDS["all"], {"marker_area_px": EDGES}
    told = failure_composition(results, ("solver",), bins=bins)
    groups = poses(results, "estimate", ("solver",), bins)
    assert_all_agree(by_outcome(told), groups, ("solver", *bins), expected_composition)


def test_the_detection_rate_is_the_same_for_every_solver():
    results = GRIDS["all"]
    told = detection_rate(results, ("solver", "tilt_deg"))
    alone = detection_rate(results, ("tilt_deg",))
    for k in range(2):
        for name in ("detected", "looked_for", "detection_rate", "detection_rate_low"):
            np.testing.assert_array_equal(told[name].isel(solver=k), alone[name])


FUNCTIONS_OF_ONE = pytest.mark.parametrize(
    "function", [detection_rate, flip_rate, failure_composition, error_statistics])


@FUNCTIONS_OF_ONE
def test_what_was_not_run_changes_nothing_but_its_own_count(function):
    # An unfinished store: trials that were never reached are fill values.
    short = GRIDS["draws"].isel(trial=slice(50))
    longer = GRIDS["draws"].isel(trial=slice(80)).copy(deep=True)
    longer["detection"][{"trial": slice(50, None)}] = DetectionStatus.not_run
    longer["estimate"][{"trial": slice(50, None)}] = EstimateStatus.not_run
    longer["flipped"][{"trial": slice(50, None)}] = Flipped.not_run
    for name in longer.data_vars:
        if longer[name].dtype.kind == "f":
            longer[name][{"trial": slice(50, None)}] = np.nan
    told, expected = (function(results, ("tilt_deg",)).compute() for results in (longer, short))
    if function is failure_composition:
        more = (told["count"] - expected["count"]).sel(outcome="not_run")
        assert more.values.tolist() == [60, 60]
        told, expected = (table.drop_sel(outcome="not_run") for table in (told, expected))
    xr.testing.assert_allclose(told, expected, rtol=1e-12)


@FUNCTIONS_OF_ONE
def test_settings_that_see_the_same_draws_add_no_certainty(function):
    one = mixed({"marker_id": 2, "trial": 40, "solver": 1}, 9, good=0.9)
    many = xr.concat(
        [one.assign_coords(solver=[name]) for name in ("ippe", "iterative", "sqpnp")],
        dim="solver", data_vars="minimal").transpose(*one.dims)
    alone, pooled = function(one).compute(), function(many).compute()
    for name in alone.data_vars:
        if alone[name].dtype.kind == "f" and "_sd_" not in name:  # which has n - 1
            np.testing.assert_allclose(pooled[name], alone[name], rtol=1e-7, err_msg=name)


@FUNCTIONS_OF_ONE
def test_variables_are_described_and_lie_in_their_intervals(function):
    told = function(GRIDS["draws"], ("tilt_deg",)).compute()
    for name, array in told.data_vars.items():
        assert array.attrs["long_name"], name
        assert "units" in array.attrs or "flag_meanings" in array.attrs, name
        if f"{name}_low" in told:
            assert not (told[f"{name}_low"] > array).any(), name
            assert not (told[f"{name}_high"] < array).any(), name
    assert told["tilt_deg"].values.tolist() == VALUES["tilt_deg"][:2]


def test_a_small_spread_about_a_large_bias_keeps_its_digits():
    rng = np.random.default_rng(11)
    sizes = {"marker_id": 3, "trial": 40}
    vectors = 1.0 + 1e-5 * rng.normal(size=(*sizes.values(), 3)) + 1e-4 * np.arange(3)[
        :, None, None]
    results = perfect(rng, sizes, rotation=vectors, position=1e3 * vectors)
    groups = poses(results, "estimate")
    assert_all_agree(error_statistics(results), groups, (), expected_errors)
    assert_all_agree(error_statistics(results.chunk(trial=7, marker_id=1)).compute(), groups, (),
                     expected_errors)


@FUNCTIONS
def test_a_single_pose_is_a_dataset_too(function, of, expected):
    results = GRIDS["plain"].isel(trial=0, marker_id=0, distance_m=0)
    assert_all_agree(function(results), poses(results, of), (), expected)


@FUNCTIONS_OF_ONE
def test_where_nothing_was_looked_for_nothing_is_said(function):
    results = GRIDS["plain"].copy(deep=True)
    results["detection"].values[...] = DetectionStatus.not_visible
    results["estimate"].values[...] = EstimateStatus.no_detection
    results["flipped"].values[...] = Flipped.no_estimate
    for per in ((), ("distance_m",)):
        for name, array in function(results, per).compute().data_vars.items():
            if array.dtype.kind == "f":
                assert array.isnull().all(), name


@FUNCTIONS_OF_ONE
def test_a_dimension_that_is_not_there_is_told_in_one_line(function):
    with pytest.raises(StoreError, match=r"^speed: no such dimension; there are .*") as told:
        function(GRIDS["plain"], per=("speed",))
    assert "\n" not in str(told.value)
    assert all(name in str(told.value) for name in ("trial", "distance_m", "marker_id"))
    with pytest.raises(StoreError, match="speed"):
        function(GRIDS["plain"], bins={"speed": [0.0, 1.0]})


# The references themselves.

def test_the_pipelines_of_the_datasets_are_valid():
    for results in GRIDS.values():
        Pipeline.from_text(results.attrs["pipeline"])


@pytest.mark.parametrize("n", [1, 2, 7, 50, 1000])
def test_the_references_intervals_are_those_of_statsmodels(n):
    for k in {0, 1, n // 3, n - 1, n}:
        for method, interval in (("wilson", wilson), ("jeffreys", jeffreys)):
            low, high = proportion.proportion_confint(k, n, method=method)
            mine = interval(k, n)
            if k > 0:  # at none and all of n Jeffreys' ends are 0 and 1: BCD 2001, section 3.1.3
                assert mine[0] == pytest.approx(low, rel=1e-9)
            if k < n:
                assert mine[1] == pytest.approx(high, rel=1e-9)


def test_the_references_mean_without_cells_is_students():
    rng = np.random.default_rng(10)
    values = rng.normal(3, 1, 20)
    found = [({"cell": (), "draw": k}, value) for k, value in enumerate(values)]
    mean, error, freedom = mean_of(found, [pose for pose, _ in found])
    ends = stats.ttest_1samp(values, 0).confidence_interval(0.95)
    assert freedom == 19
    assert student(mean, error, freedom) == pytest.approx((values.mean(), ends.low, ends.high))


# What users do to datasets.

def test_what_was_cut_away_was_not_run():
    whole = GRIDS["draws"]
    cut = whole.where(whole["marker_area_px"] > float(whole["marker_area_px"].median()))
    kept = {"marker_area_px": [float(np.nextafter(whole["marker_area_px"].median(), np.inf)), 1e9]}
    expected = detection_rate(whole, bins=kept).isel(marker_area_px=0)
    for name in ("looked_for", "detected", "detection_rate"):
        assert detection_rate(cut)[name] == expected[name], name


def test_a_draw_with_more_solved_settings_counts_more():
    # Kish 1965: 10 draws with 30 settings each and 90 with one are worth 19 draws, not 100.
    results = perfect(np.random.default_rng(1), {"trial": 100, "solver": 30})
    results["estimate"].values[10:, 1:] = EstimateStatus.solver_failed
    told = flip_rate(results)
    assert told["solved"] == 10 * 30 + 90
    assert told["draws"] == (10 * 30 + 90) ** 2 // (10 * 30**2 + 90) == 16


def test_a_solved_pose_without_a_number_counts_in_no_mean():
    results = perfect(np.random.default_rng(2), {"trial": 60})
    results["rotation_error_rad"].values[:3] = np.nan
    told, without = error_statistics(results), error_statistics(results.isel(trial=slice(3, None)))
    for name in ("rotation_rmse_deg", "rotation_sd_deg", "rotation_bias_deg"):
        assert told[name].item() == pytest.approx(without[name].item(), rel=1e-12), name
    assert told["rotation_p99_deg"] == np.inf


@pytest.mark.parametrize(("call", "message"), [
    (lambda r: detection_rate(r, per=[3]), "expected names of dimensions"),
    (lambda r: detection_rate(r, per=None), "expected names of dimensions"),
    (lambda r: detection_rate(r, bins=["marker_area_px"]), "expected names with edges"),
    (lambda r: detection_rate(r, bins={"marker_area_px": "abc"}), "two increasing edges"),
    (lambda r: detection_rate(r, bins={"marker_area_px": [1, np.nan]}), "two increasing edges"),
    (lambda r: detection_rate(r.drop_vars("estimate")), "no variable estimate; there are"),
    (lambda _: error_statistics(xr.Dataset()), "no variable detection, estimate"),
    (lambda r: detection_rate(r.isel(trial=slice(0))), "there are no poses: trial has no values"),
])
def test_what_cannot_be_asked_is_told_in_one_line(call, message):
    with pytest.raises(StoreError, match=message) as refused:
        call(GRIDS["draws"])
    assert "\n" not in str(refused.value)
