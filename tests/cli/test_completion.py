"""Shell completion: the shells read the scripts, which name every command and option."""

import shutil
import subprocess
import sys

import pytest

from sweep import cli
from sweep.cli.parser import build_parser


@pytest.mark.system
@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_each_script_is_one_of_its_shell_and_has_every_command_and_option(shell, capsys, tmp_path):
    pytest.importorskip("shtab")
    assert cli.main(["completion", shell]) == 0
    text = capsys.readouterr().out
    for parser in build_parser()[1]:
        assert parser.prog.removeprefix("sweep ") in text
        for option in parser._option_string_actions:
            assert option.lstrip("-") in text
    if shutil.which(shell) is not None:
        (tmp_path / "script").write_text(text)
        subprocess.run([shell, "-n", tmp_path / "script"], check=True)


def test_without_its_package_the_remedy_is_one_line(capsys, monkeypatch):
    monkeypatch.setitem(sys.modules, "shtab", None)
    assert cli.main(["completion", "bash"]) == 1
    assert capsys.readouterr().err.strip().endswith("pip install shtab")
