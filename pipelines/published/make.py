"""Run the register's pipelines again and write its tables.

python pipelines/published/make.py [--table] [--quick] [NAME ...]
"""

import argparse
import itertools
import tempfile
import tomllib
from pathlib import Path

import numpy as np
import xarray as xr
from scipy.stats import binomtest

import sweep
from sweep.measure.flags import DetectionStatus, EstimateStatus, Flipped

FOLDER = Path(__file__).parent
REGISTER = FOLDER / "register"
README = FOLDER / "README.md"
RESAMPLES = 100


def solved(part, name):
    """Return the values of the solved poses, all other dimensions stacked."""
    values = part[name].where(part.estimate == EstimateStatus.solved)
    inner = [each for each in ("xyz", "corner", "xy") if each in values.dims]
    outer = [each for each in values.dims if each not in inner]
    values = values.transpose(*outer, *inner).values.astype(float)
    values = values.reshape(-1, *values.shape[len(outer):])
    return values[np.isfinite(values).reshape(len(values), -1).all(axis=1)]


def jitter_ratio(part):
    jitter = part.corner_error_px.std("trial")
    rms = np.sqrt((jitter**2).mean([each for each in jitter.dims
                                    if each != "cornerRefinementMethod"]))
    return float(rms.sel(cornerRefinementMethod="apriltag")
                 / rms.sel(cornerRefinementMethod="subpix"))


def flip_share(part):
    """Of poses with a solution: nearer to the mirrored pose than to the true one."""
    return (solved(part, "flipped") == Flipped.flipped).mean()


def stereo_z_mm(part):
    """z² / (f b) times the spread of the mean disparity of four corners in two images."""
    errors = part.corner_error_px.sel(xy="x").values.astype(float)
    errors = errors[np.isfinite(errors)]
    z, focal, baseline = part.attrs["z_m"], 1080, 0.065
    return 1e3 * z**2 / (focal * baseline) * errors.std() * np.sqrt(2 / 4)


def lateral_p95_mm(part):
    return 1e3 * np.quantile(np.abs(solved(part, "translation_error_m")[:, 0]), 0.95)


def eight_corner_offset(part):
    """Half a pixel, and the mean of eight corners' own error: two markers' at a time."""
    errors = solved(part, "corner_error_px")[:, :, 0].mean(axis=1)
    pairs = errors[: len(errors) // 2 * 2].reshape(-1, 2).mean(axis=1)
    return -0.5 + pairs[0]


def mean_x_mm(part):
    return 1e3 * solved(part, "translation_error_m")[:, 0].mean()


def sd_z_mm(part):
    return 1e3 * solved(part, "translation_error_m")[:, 2].std()


def median_position_mm(part):
    return 1e3 * np.median(np.linalg.norm(solved(part, "translation_error_m"), axis=1))


def read_distance_cm(part):
    return 100 * (0.142 + solved(part, "translation_error_m")[:, 2].mean())


def range_ratio(part):
    rates = (part.detection == DetectionStatus.detected).mean("trial")
    ranges = [part.distance_m.values[rates.sel(dictionary=name).values >= 0.9].max(initial=0)
              for name in ("DICT_APRILTAG_16h5", "DICT_APRILTAG_36h11")]
    return ranges[0] / ranges[1] if ranges[1] else np.nan


STATISTICS = {each.__name__: each for each in (
    jitter_ratio, flip_share, stereo_z_mm, lateral_p95_mm, eight_corner_offset, mean_x_mm, sd_z_mm,
    median_position_mm, read_distance_cm, range_ratio)}


def entries():
    return {path.stem: tomllib.loads(path.read_text()) for path in sorted(REGISTER.glob("*.toml"))}


def results_of(pipeline, quick, **changes):
    """Run a pipeline, with keys of its sections changed."""
    content = {key: dict(value) if isinstance(value, dict) else value
               for key, value in pipeline.items()}
    for section, values in changes.items():
        content[section] = {**content.get(section, {}), **values}
    if quick:
        content["axes"]["trial"] = min(content["axes"]["trial"], 8)
    with tempfile.TemporaryDirectory() as folder:
        results = sweep.run(content, store=Path(folder) / "run.zarr", progress=False).load()
    results.attrs["z_m"] = content["pose"].get("distance_m")
    return results


def interval(results, entry):
    """Least and greatest value over what is not known, 95 % of resamples of the trials each."""
    statistic = STATISTICS[entry["statistic"]]
    random = np.random.default_rng(0)
    found = []
    for values in itertools.product(*(results[name].values for name in entry["over"])):
        part = results.sel(dict(zip(entry["over"], values, strict=True)))
        resampled = [
            statistic(part.isel(trial=xr.DataArray(
                random.integers(part.sizes["trial"], size=part.sizes["trial"]), dims="trial")))
            for _ in range(RESAMPLES)]
        found.append(np.nanquantile(resampled, [0.025, 0.5, 0.975]))
    intervals = np.array(found)
    return (float(intervals[:, 0].min()), float(np.median(intervals[:, 1])),
            float(intervals[:, 2].max()))


def verdict(entry):
    predicted, measured = entry["prediction"], entry["measured"]
    inside = (predicted["low"] - measured["reading_error"] <= measured["value"]
              <= predicted["high"] + measured["reading_error"])
    return "hit" if inside else "miss"


def table():
    """Return the register's table, from its files alone."""
    lines = ["| study | quantity | predicted | measured | verdict |", "|" + " --- |" * 5]
    explained = []
    hits = []
    for name, entry in entries().items():
        predicted, measured = entry["prediction"], entry["measured"]
        hits.append(verdict(entry) == "hit")
        unit = "" if entry["unit"] == "1" else f" {entry['unit']}"
        lines.append(
            f"| [{name}](register/{name}.toml) | {entry['title']} | "
            f"{predicted['low']:.3g} to {predicted['high']:.3g}{unit} | {measured['value']:g} ± "
            f"{measured['reading_error']:g} | {verdict(entry)} |")
        if run := entry.get("explained"):
            explained.append(f"- {name}: with {run['by']} the same pipeline gives {run['low']:.3g} "
                             f"to {run['high']:.3g}{unit}.")
    exact = binomtest(sum(hits), len(hits)).proportion_ci(method="exact")
    share = f"{sum(hits)} hits of {len(hits)}: {sum(hits) / len(hits):.0%}"
    return "\n".join([
        *lines, "", f"{share} (95 % interval {exact.low:.0%} to {exact.high:.0%}).", "",
        "Misses that a second run explains:", "", *explained])


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("names", nargs="*")
    parser.add_argument("--quick", action="store_true", help="at most 8 trials")
    parser.add_argument("--table", action="store_true", help="only print the table of the files")
    options = parser.parse_args()
    print(table(), flush=True)
    if options.table:
        return
    for name, entry in entries().items():
        if not options.names or name in options.names:
            again = interval(results_of(entry["pipeline"], options.quick), entry)
            print(f"{name}: {again[0]:.4g} to {again[2]:.4g} {entry['unit']}, "
                  f"middle {again[1]:.4g}", flush=True)
            if run := entry.get("explained"):
                low, _, high = interval(
                    results_of(entry["pipeline"], options.quick, **run["changes"]), entry)
                print(f"{name}, {run['by']}: {low:.4g} to {high:.4g} {entry['unit']}", flush=True)


if __name__ == "__main__":
    main()
