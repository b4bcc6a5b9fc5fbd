"""Tables of truth and answers, and the answers of the program that an export's README shows."""

import contextlib
import csv
import re
import runpy


def answer(folder):
    """Run the README's script, which knows nothing of sweep, in an export's folder."""
    script = re.search(r"```python\n(.*?)```", (folder / "README.md").read_text(), re.DOTALL)[1]
    assert "sweep" not in script
    file = folder.parent / "program.py"
    file.write_text(script)
    with contextlib.chdir(folder):
        runpy.run_path(str(file))


def rows_of(path):
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


def write(path, rows):
    with path.open("w", newline="") as file:
        table = csv.DictWriter(file, list(rows[0]))
        table.writeheader()
        table.writerows(rows)
    return path
