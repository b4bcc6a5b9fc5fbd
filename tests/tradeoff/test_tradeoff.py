"""What accuracy costs, from a store to the tables: `sweep tradeoff`, and how costs are measured."""

import itertools
import json
import math
from types import SimpleNamespace

import numpy as np
import pytest
import xarray as xr
from scipy import stats

from support.reports import command, made
from sweep.execution.runner import execute
from sweep.execution.status import status
from sweep.experiment.pipeline import Pipeline
from sweep.isolation.child_process import Interrupts
from sweep.measure.flags import DetectionStatus, EstimateStatus
from sweep.report.table import to_json
from sweep.tradeoff import costs
from sweep.tradeoff import measurement as tradeoff
from sweep.tradeoff.costs import LEAST_ROUNDS, MIN_ROUNDS, median_interval, time_in_turns
from sweep.tradeoff.verdicts import first_verdict, verdict

CAMERA = """
seed = 3
[camera]
width_px = 200
height_px = 160
sensor_width_mm = 4.8
sensor_height_mm = 3.84
focal_length_mm = 4.0
[pose]
jitter_px = 0.5
azimuth_deg = { uniform = [0, 360] }
roll_deg = { uniform = [0, 360] }
"""

# At 15 px some are missed, at 60 px none.
TRADE = f"""
{CAMERA}
[scene]
black = 40
white = 220
background = 120
noise_grey = 6
bound = "known_blur"
[estimator]
corner_noise_px = 0.3
[axes]
side_px = [15, 60]
tilt_deg = [10, 40]
cornerRefinementMethod = ["none", "subpix"]
solver = ["ippe_square", "iterative", "photometric"]
trial = 20
"""

RENDERERS = f"""
{CAMERA}
[axes]
side_px = [25, 60]
renderer = ["warp", "exact", "supersample-2", "supersample-8"]
solver = ["ippe_square", "iterative"]
trial = 12
"""


@pytest.fixture(scope="module", autouse=True)
def _few_scenes():
    """Measure costs on few scenes: what is told is the same, and sooner."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(costs, "MAX_SCENES", 4)
        yield


def told(*arguments):
    """Return what the command prints, where it is content."""
    code, out, err = command("tradeoff", *arguments)
    assert code == 0, err
    assert all(line.startswith(("reading the accuracy", "measuring ")) for line in err.splitlines())
    return out


@pytest.fixture(scope="module")
def store(tmp_path_factory):
    return made(tmp_path_factory.mktemp("trade"), TRADE, "trade")


@pytest.fixture(scope="module")
def trade(store):
    """What the command says of the store as JSON, told apart by side_px, and what it wrote."""
    said = json.loads(told(
        store, "--per", "side_px", "--seconds", "0.05", "--budget-ms", "1e9", "--json"))
    return said, group(store, "cost/tradeoff")


def group(store, name=None):
    with xr.open_zarr(store, group=name) as written:
        return written.load()


def test_accuracy_is_that_of_plain_arithmetic_on_the_store(trade, store):
    """Its treatments are refinements by solvers, in order."""
    treatments = ("cornerRefinementMethod", "solver")
    dims = ("side_px", *treatments, "tilt_deg", "trial")
    wide, = xr.broadcast(group(store))
    seen = (wide["detection"] == DetectionStatus.detected).transpose(*dims, ...).values
    solved = (wide["estimate"] == EstimateStatus.solved).transpose(*dims, ...).values
    rotation = wide["rotation_error_deg"].transpose(*dims, ...).values
    seen, solved, rotation = (
        array.reshape(2, 6, 40, -1)[..., 0] for array in (seen, solved, rotation))
    mean = np.nanmean(np.where(solved, rotation.astype(float), np.nan) ** 2, axis=-1)
    _, written = trade
    assert written["detection_rate"].values == pytest.approx(seen.mean(axis=-1))
    assert written["solved_rate"].values == pytest.approx(solved.mean(axis=-1))
    assert written["rotation_rmse_deg"].values == pytest.approx(np.sqrt(mean), rel=1e-6)
    assert (written["detection_rate"][0] < 1).all()
    assert np.isinf(written["rotation_p99_deg"][0]).all()


def test_the_group_holds_what_was_printed_and_the_store_is_as_before(store, trade):
    results, spent = group(store), group(store, "cost")
    assert "side_px" in trade[0]["dims"]  # of which nothing is to be left
    printed = json.loads(told(
        store, "--seconds", "0.02", "--per", "tilt_deg", "--budget-ms", "1e-6", "--json"))
    assert "nothing fits 1e-06 ms a frame; the nearest is " in " ".join(printed.pop("advice"))
    written = group(store, "cost/tradeoff")
    assert written["cost_ms"].dims == ("tilt_deg", "treatment")
    again = json.loads(to_json(written.to_dict()))
    for part in ("attrs", "dims", "data_vars"):
        assert again[part] == printed[part]
    again, said = ({name: one["data"] for name, one in each["coords"].items()}
                   for each in (again, printed))
    assert again == said
    assert group(store).equals(results)
    assert group(store, "cost").identical(spent)
    assert status(store).finished
    assert execute(Pipeline.from_text(TRADE, name="trade"), store, workers=1).computed_blocks == 0


def test_cheaper_images_differ_from_exact_ones_and_exact_ones_do_not(tmp_path):
    url = made(tmp_path, RENDERERS, "renderers")
    said = json.loads(told(url, "--seconds", "0.1", "--json"))["renderers"]
    written = group(url, "cost/renderers")
    assert json.loads(to_json(written.to_dict()))["data_vars"] == said["data_vars"]
    exact, others = (written.sel(renderer=names) for names in (
        "exact", ["warp", "supersample-2", "supersample-8"]))
    warp, two, eight = others["grey_rms"].values
    assert two > eight > 0 < warp
    assert (written["grey_max"] >= written["grey_rms"]).all()
    for name in ("grey_rms", "grey_max", "detection_disagreement", "corner_shift_rms_px",
                 "range_bias_percent", "rotation_shift_deg"):
        assert (exact[name] == 0).all(), name
    assert (others["corner_shift_rms_px"] > 0).all()
    for end in ("", "_low", "_high"):
        assert exact[f"render_ratio{end}"] == 1
    assert (written["render_ms"] > 0).all()
    # 64 samples a pixel against 4.
    assert others["render_ms"][2] > 2 * others["render_ms"][1]


@pytest.mark.parametrize(("arguments", "message"), [
    (["--per", "zzz"], "--per zzz: no axis of the scene; there are side_px, tilt_deg"),
    (["--per", "trial"], "--per trial: trials are draws"),
    (["--criterion", "cost_ms"], "--criterion cost_ms: expected one of rotation_rmse_deg, "),
    (["--budget-ms", "0"], "--budget-ms 0.0: expected a finite number above 0"),
    (["--output", "figure.jpg"], "figure.jpg: expected a file that ends in .png or .svg"),
    (["--output", "missing/figure.png"], "folder missing not found"),
])
def test_bad_arguments_are_told_in_one_line_before_anything_is_measured(
    arguments, message, store, monkeypatch
):
    monkeypatch.setattr(tradeoff, "_trade", pytest.fail)
    code, out, err = command("tradeoff", store, *arguments)
    assert (code, out, message in err) == (2, "", True)
    assert err.count("\n") == 1


class Clock:
    """Time that passes only where something is done."""

    def __init__(self):
        self.now = 0.0
        self.order = []

    def part(self, number, cost):
        """Return something to be measured that takes ``cost(call)`` seconds."""
        calls = itertools.count()

        def run():
            self.order.append(number)
            self.now += cost(next(calls))

        return run


@pytest.fixture
def clock(monkeypatch):
    one = Clock()
    monkeypatch.setattr(costs, "time", SimpleNamespace(
        thread_time=lambda: one.now, perf_counter=lambda: one.now))
    return one


def to_first(seconds):
    return seconds / seconds[:, :1]


def test_rounds_go_on_until_the_widest_ratio_is_narrow(clock):
    noise = np.random.default_rng(1).lognormal(0, 0.05, 2000)
    parts = [clock.part(0, lambda _: 1.0), clock.part(1, lambda call: 2.0 * noise[call])]
    seconds = time_in_turns(parts, to_first, math.inf, Interrupts())
    assert MIN_ROUNDS < len(seconds) < 2000 - 1

    def width(count):
        value, low, high = median_interval(to_first(seconds[:count]))
        return ((high - low) / value).max()

    assert width(len(seconds)) <= costs.NARROW
    assert all(width(count) > costs.NARROW for count in range(MIN_ROUNDS, len(seconds)))


@pytest.mark.parametrize(("limit", "most", "rounds"), [
    (100.0, 1000, 32), (1.0, 1000, LEAST_ROUNDS), (math.inf, 50, 49)])
def test_rounds_end_at_the_limit_but_not_before_there_are_enough(
    clock, monkeypatch, limit, most, rounds
):
    monkeypatch.setattr(costs, "MAX_ROUNDS", most)
    parts = [clock.part(0, lambda _: 1.0), clock.part(1, lambda call: 1.0 + 2.0 * (call % 2))]
    # Rounds of 2 and 4 s by turns, the first of which warms up: 33 rounds take 98 s.
    assert len(time_in_turns(parts, to_first, limit, Interrupts())) == rounds


def test_each_round_has_every_part_once_in_an_order_of_its_own(clock):
    count = 6
    parts = [clock.part(k, lambda call: 100.0 if call == 0 else 1.0) for k in range(count)]
    # The first round warms up.
    assert (time_in_turns(parts, to_first, math.inf, Interrupts()) == 1.0).all()
    rounds = np.reshape(clock.order, (MIN_ROUNDS + 1, count))
    assert (np.sort(rounds) == np.arange(count)).all()
    # 13 of 720 orders: two of them may be the same.
    assert len(np.unique(rounds, axis=0)) > len(rounds) // 2
    assert len(np.unique(rounds[:, 0])) > 1


@pytest.mark.parametrize("count", [6, MIN_ROUNDS, 13, 60, 1999])
def test_the_medians_interval_is_the_narrowest_of_order_statistics_that_covers(count):
    value, low, high = median_interval(np.random.default_rng(0).permutation(count).astype(float))
    assert value == (count - 1) / 2
    assert low + high == count - 1

    def coverage(rank):
        return 1 - 2 * stats.binom.cdf(rank, count, 0.5)

    assert coverage(low) >= 0.95 > coverage(low + 1)


@pytest.mark.parametrize(("low", "high", "equal", "expected"), [
    (0.1, 0.3, 0.0, "better"), (-3.0, -0.1, 0.0, "worse"), (-1.0, 0.9, 0.0, "equivalent"),
    (-1.1, 0.0, 0.0, "not decided"), (1.001, 1.01, 1.0, "worse"), (0.3, 0.9, 1.0, "better"),
    (0.96, 1.04, 1.0, "equivalent"), (0.94, 1.0, 1.0, "not decided"),
    (math.nan, math.nan, 1.0, "not decided"),
])
def test_verdicts(low, high, equal, expected):
    assert verdict(low, high, equal) == expected
    assert first_verdict(["equivalent", expected]) == (
        "not decided" if expected == "not decided" else expected)
