"""Run the notebooks and store them with their outputs.

    python notebooks/make.py [NAME ...]

The outputs are those of the sources: a digest of the sources is stored beside them, and a test
compares it. Times that a notebook prints are those of the machine at hand.
"""

import argparse
import hashlib
import json
import os
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient

FOLDER = Path(__file__).parent
TIMEOUT_S = 1800
"""Limit of a cell's time, in seconds."""


def source_digest(notebook: nbformat.NotebookNode) -> str:
    """Return the SHA-256 digest of the kinds and sources of a notebook's cells."""
    sources = [[cell.cell_type, cell.source] for cell in notebook.cells]
    return hashlib.sha256(json.dumps(sources).encode()).hexdigest()


def execute(path: Path, runs: Path) -> None:
    """Run a notebook with its stores in ``runs``, and write it with its outputs."""
    notebook = nbformat.read(path, as_version=4)
    metadata = {"kernelspec": notebook.metadata.kernelspec, "language_info": {"name": "python"}}
    client = NotebookClient(
        notebook, timeout=TIMEOUT_S, kernel_name="python3", record_timing=False,
        resources={"metadata": {"path": str(FOLDER)}})
    client.execute(env=os.environ | {"SWEEP_RUNS": str(runs)})
    for cell in notebook.cells:
        cell.metadata = {}
    notebook.metadata = metadata | {"sweep": {"source_digest": source_digest(notebook)}}
    nbformat.validate(notebook)
    # Attributes of a dataset name folders; those of this machine are nobody's business.
    text = nbformat.writes(notebook).replace(str(runs), "runs").replace(str(FOLDER.parent), "sweep")
    path.write_text(text.rstrip("\n") + "\n")
    print(f"{path.name}: {path.stat().st_size / 1e3:.0f} kB")


def main() -> None:
    """Run the notebooks that are named, or all of them."""
    names = sorted(path.stem for path in FOLDER.glob("*.ipynb"))
    parser = argparse.ArgumentParser(description="Run notebooks, store them with their outputs.")
    parser.add_argument("names", metavar="NAME", nargs="*", choices=[*names, []])
    for name in parser.parse_args().names or names:
        with tempfile.TemporaryDirectory(prefix="sweep-") as runs:
            execute(FOLDER / f"{name}.ipynb", Path(runs))


if __name__ == "__main__":
    main()
