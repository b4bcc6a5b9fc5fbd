"""Shell completion: what a shell offers behind what was typed."""

import shutil
import subprocess

import pytest

from sweep import cli
from sweep.cli.completion import SHELLS, completions
from sweep.cli.parser import COMMANDS
from sweep.plan.parameters import PARAMETERS

ASK = """
source "$1"
compopt() { :; }
COMP_LINE=$2 COMP_POINT=${#2}
_sweep
printf '%s\\n' "${COMPREPLY[@]}"
"""


def script(shell, capsys):
    assert cli.main(["completion", shell]) == 0
    return capsys.readouterr().out


@pytest.mark.parametrize("shell", SHELLS)
def test_every_command_option_and_parameter_is_in_each_script(shell, capsys):
    text = script(shell, capsys)
    for each in completions(COMMANDS):
        assert each.command in text
        for option in each.options:
            assert (option if shell != "fish" else option.lstrip("-")) in text
    for name in (*PARAMETERS, "trial"):
        assert f"{name}=" in text


@pytest.mark.parametrize(("shell", "check"), [("bash", "-n"), ("zsh", "-n"), ("fish", "-n")])
def test_each_script_is_one_of_its_shell(shell, check, capsys, tmp_path):
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    (tmp_path / "script").write_text(script(shell, capsys))
    subprocess.run([shell, check, tmp_path / "script"], check=True)


@pytest.mark.skipif(shutil.which("bash") is None, reason="bash is not installed")
@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("sweep r", ["run", "repro", "report", "require"]),
        ("sweep plan sm", ["small.toml"]),
        ("sweep plan ", ["runs", "small.toml"]),
        ("sweep report runs/", ["runs/small.zarr"]),
        ("sweep run small.toml --re", ["--reuse", "--retry-failed"]),
        ("sweep run small.toml --set til", ["tilt_deg="]),
        ("sweep run small.toml --set tilt_deg=", []),
        ("sweep show small.toml --at roll", ["roll_deg="]),
        # Of a word with equals signs, readline replaces what follows the last one.
        ("sweep show small.toml --at tilt_deg=3,roll", ["3,roll_deg="]),
        ("sweep report runs/small.zarr --format ", ["html", "md"]),
        ("sweep run small.toml --workers ", []),
        ("sweep limit small.toml --along distan", ["distance_m"]),
        ("sweep limit small.toml --per tilt_deg,roll", ["tilt_deg,roll_deg"]),
        ("sweep run small.toml --prec", ["--precision"]),
        ("sweep completion ", ["bash", "zsh", "fish"]),
    ],
)
def test_bash_offers_what_may_follow(line, offered, capsys, tmp_path):
    (tmp_path / "script").write_text(script("bash", capsys))
    work = tmp_path / "work"
    (work / "runs/small.zarr").mkdir(parents=True)
    (work / "small.toml").touch()
    (work / "other.txt").touch()
    done = subprocess.run(
        ["bash", "-c", ASK, "bash", tmp_path / "script", line], cwd=work, capture_output=True,
        text=True, check=True,
    )
    assert sorted(done.stdout.split()) == sorted(offered)
    assert done.stderr == ""
