"""Error models as files: code gives the numbers of `model_errors`, and text is what it says."""

import json
import math
import runpy
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from support.pose_errors import FX, SIZE_M, poses_with_law, power_law
from sweep.analysis import error_models, model_covariance, model_errors
from sweep.analysis.error_models import Use
from sweep.cli import main
from sweep.errors import ArgumentError
from sweep.report.error_model_file import (
    check_error_model_file,
    configuration_names,
    error_model_text,
    stacked,
)
from sweep.report.error_model_table import error_model_table, exponent_lines

ABOUT = {"store": 'runs/"odd" */ name.zarr', "title": "Tags \u00e4", "fingerprint": {}}


@pytest.fixture(scope="module")
def models():
    axes = {"distance_m": [1.0, 2.0, 4.0], "tilt_deg": [0.0, 30.0, 60.0], "solver": ["a", "b"],
            "trial": list(range(60))}
    return error_models(poses_with_law(8, axes, power_law, bearing_deg=20.0))


def poses(count):
    """Return rows of model, x, y, z, viewing angle, in the domain and around it."""
    rng = np.random.default_rng(1)
    z = np.exp(rng.uniform(np.log(0.9), np.log(4.5), count))
    x, y = rng.uniform(-0.5, 0.5, (2, count)) * z
    angle = rng.uniform(-5, 90, count)
    angle[:3], z[:3] = (0.0, 30.0, 0.0), (1.0, 2.0, 4.0)
    return np.stack([np.arange(count) % 2, x, y, z, angle], axis=-1)


def expected(models, rows):
    """Return sigma, bias, use, rates, covariance and its bias of each pose, a row of 62 numbers."""
    found = []
    for k in (0, 1):
        here = rows[rows[:, 0] == k]
        one = models.isel(solver=k)
        errors = model_errors(one, here[:, 3], here[:, 4])
        camera = model_covariance(one, here[:, 1:4], here[:, 4])
        found.append(np.concatenate([
            errors.sigma, errors.bias, errors.use, errors.flip_rate.values[:, None],
            errors.solved_rate.values[:, None], camera.covariance.values.reshape(-1, 36),
            camera.bias], axis=1))
    out = np.empty((len(rows), found[0].shape[1]))
    for k in (0, 1):
        out[rows[:, 0] == k] = found[k]
    return out


def agree(rows, wanted, found):
    assert (np.isnan(found) == np.isnan(wanted)).all()
    assert 0 < np.isnan(wanted[:, 0]).sum() < len(rows)
    sigma = wanted[:, :6]
    # Of covariances relative to the product of the standard deviations, which may cancel.
    largest = np.repeat(np.maximum.reduceat(sigma, [0, 3], axis=1), 3, axis=1)
    scale = np.concatenate([
        sigma, largest, np.ones((len(rows), 8)),
        (largest[:, :, None] * largest[:, None, :]).reshape(-1, 36),
        np.maximum(largest, np.abs(wanted[:, 56:]))], axis=1)
    assert np.nanmax(np.abs(found - wanted) / np.where(scale > 0, scale, 1.0)) < 1e-12


def test_the_python_code_gives_the_same_numbers(models, tmp_path):
    path = tmp_path / "tag.py"
    path.write_text(error_model_text(models, ABOUT, str(path)))
    code = runpy.run_path(str(path))
    rows, found = poses(60), []
    for k, x, y, z, angle in rows:
        errors = code["errors"](int(k), z, angle)
        covariance, bias, use = code["camera_errors"](int(k), x, y, z, angle)
        assert use == errors["use"]
        found.append([
            *errors["sigma"], *errors["bias"], *(Use[name].value for name in use),
            errors["flip_rate"], errors["solved_rate"], *covariance, *bias])
    agree(rows, expected(models, rows), np.array(found))
    assert code["viewing_angle_deg"](0, 0, 2, 0, 0, -1) == 0
    assert code["viewing_angle_deg"](0, 0, 2, 0, math.sqrt(0.5), -math.sqrt(0.5)) == (
        pytest.approx(45))


CPP = """#include "tag.hpp"
#include <cstdio>
int main() {
    double k, x, y, z, a;
    while (std::scanf("%lf %lf %lf %lf %lf", &k, &x, &y, &z, &a) == 5) {
        const auto e = tag::errors(static_cast<int>(k), z, a);
        const auto c = tag::camera_errors(static_cast<int>(k), x, y, z, a);
        for (double v : e.sigma) std::printf("%.17g ", v);
        for (double v : e.bias) std::printf("%.17g ", v);
        for (int v : e.use) std::printf("%d ", v);
        std::printf("%.17g %.17g ", e.flip_rate, e.solved_rate);
        for (double v : c.covariance) std::printf("%.17g ", v);
        for (double v : c.bias) std::printf("%.17g ", v);
        std::printf("\\n");
    }
}
"""

JAVA = """import java.util.Locale;
import java.util.Scanner;
public class Main {
    public static void main(String[] arguments) {
        Scanner in = new Scanner(System.in).useLocale(Locale.ROOT);
        StringBuilder out = new StringBuilder();
        while (in.hasNext()) {
            int k = (int) Double.parseDouble(in.next());
            double x = Double.parseDouble(in.next());
            double y = Double.parseDouble(in.next());
            double z = Double.parseDouble(in.next());
            double a = Double.parseDouble(in.next());
            Tag.Errors e = Tag.errors(k, z, a);
            Tag.CameraErrors c = Tag.cameraErrors(k, x, y, z, a);
            for (double v : e.sigma) out.append(v).append(' ');
            for (double v : e.bias) out.append(v).append(' ');
            for (int v : e.use) out.append(v).append(' ');
            out.append(e.flipRate).append(' ').append(e.solvedRate).append(' ');
            for (double v : c.covariance) out.append(v).append(' ');
            for (double v : c.bias) out.append(v).append(' ');
            out.append(System.lineSeparator());
        }
        System.out.print(out);
    }
}
"""


def numbers_of(command, rows, folder):
    text = "\n".join(" ".join(map(repr, row)) for row in rows.tolist())
    ran = subprocess.run(
        command, input=text, capture_output=True, text=True, check=True, cwd=folder)
    return np.array([[float(word) for word in line.split()] for line in ran.stdout.splitlines()])


@pytest.mark.long
@pytest.mark.skipif(shutil.which("g++") is None, reason="there is no g++")
def test_the_cpp_code_gives_the_same_numbers(models, tmp_path):
    (tmp_path / "tag.hpp").write_text(error_model_text(models, ABOUT, "tag.hpp"))
    (tmp_path / "main.cpp").write_text(CPP)
    strict = ["-Wall", "-Wextra", "-Wpedantic", "-Werror"]
    built = subprocess.run(
        ["g++", "-std=c++17", *strict, "main.cpp", "-o", "main"],
        cwd=tmp_path, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    rows = poses(500)
    agree(rows, expected(models, rows), numbers_of(["./main"], rows, tmp_path))


@pytest.mark.long
@pytest.mark.skipif(shutil.which("javac") is None, reason="there is no javac")
def test_the_java_code_gives_the_same_numbers(models, tmp_path):
    (tmp_path / "Tag.java").write_text(error_model_text(models, ABOUT, "Tag.java"))
    (tmp_path / "Main.java").write_text(JAVA)
    built = subprocess.run(
        ["javac", "-Xlint:all", "-Werror", "Tag.java", "Main.java"],
        cwd=tmp_path, capture_output=True, text=True, check=False)
    assert built.returncode == 0, built.stderr
    rows = poses(500)
    agree(rows, expected(models, rows), numbers_of(["java", "-cp", ".", "Main"], rows, tmp_path))


def test_the_json_has_all_that_a_reader_needs(models):
    content = json.loads(error_model_text(models, ABOUT, "tag.json"))
    assert content["schema"] == "sweep-error-model/1"
    assert content["side_px"] == f"{FX * SIZE_M!r} / distance_m"
    assert content["domain"]["distance_m"] == pytest.approx([1, 4], rel=1e-5)
    assert content["domain"]["bearing_deg"][1] == pytest.approx(27, abs=3)
    assert [one["configuration"] for one in content["models"]] == [{"solver": "a"}, {"solver": "b"}]
    one = content["models"][1]
    sigma = np.array(one["quantities"]["z"]["sigma"])
    np.testing.assert_array_equal(sigma, models.isel(solver=1).sigma.sel(quantity="z"))
    low, high = map(np.array, one["quantities"]["z"]["sigma_interval"])
    assert ((low < sigma) & (sigma < high)).all()
    assert set(np.ravel(one["quantities"]["z"]["use"])) <= {flag.name for flag in Use}
    ratio = np.array(one["rule_of_thumb"]["ratio_to_sigma_of_z"])
    distance = np.array(one["knots"]["distance_m"])[:, None, None]
    np.testing.assert_allclose(ratio, 0.02 * distance**2 / sigma)


def test_the_ros_file_has_covariances_row_by_row(models):
    yaml = pytest.importorskip("yaml")
    content = yaml.safe_load(error_model_text(models, ABOUT, "tag.yaml"))
    assert len(content["covariances"]) == 2 * models.sizes["distance_m"] * (
        models.sizes["viewing_angle_deg"])
    some = content["covariances"][3]
    wanted = model_covariance(
        models.isel(solver=0), [0, 0, some["distance_m"]], some["viewing_angle_deg"])
    np.testing.assert_allclose(some["covariance"], wanted.covariance.values.ravel(), rtol=1e-12)
    assert some["use"] == [Use(flag).name for flag in wanted.use.values[0]]


def test_the_table_compares_the_usual_rule(models):
    table = error_model_table(models)
    assert table.headings[0] == "configuration"
    assert {row[0] for row in table.rows} == {"solver = a", "solver = b"}
    assert {row[table.headings.index("held-out check")] for row in table.rows} == {"few draws"}
    assert configuration_names(models) == ["solver = a", "solver = b"]
    assert stacked(models).sizes["model"] == 2
    lines = exponent_lines(models)
    assert len(lines) == 2
    for line in lines:
        assert float(line.partition("to the power ")[2].split()[0]) == pytest.approx(2.5, abs=0.15)


@pytest.mark.parametrize(("path", "words"), [
    ("model.txt", "expected a file that ends in .h, .hpp, .java, .json, .py, .yaml, .yml"),
    ("my-tag.java", "expected the name of a Java class"),
])
def test_a_file_of_no_format_is_refused(path, words):
    with pytest.raises(ArgumentError, match=words):
        check_error_model_file(path)


@pytest.mark.parametrize("arguments", [
    ["error-model", "missing.zarr", "-o", "m.txt"], ["error-model", "missing.zarr"],
    ["report", "missing.zarr", "--error-model", "m.exe"],
])
def test_the_command_refuses_in_a_line(arguments, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert main(arguments) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert not list(Path().iterdir())
