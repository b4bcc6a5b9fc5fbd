"""Write pages of the public functions, from their docstrings, with pdoc (the extra ``docs``).

python .ci/api.py FOLDER
"""

from __future__ import annotations

import sys
from pathlib import Path

import pdoc
import pdoc.render

import sweep


def main() -> None:
    """Write ``sweep`` and ``sweep.analysis`` into the folder that is named."""
    for name in sweep.__all__:  # classes are imported when they are first used; pdoc does not ask
        setattr(sweep, name, getattr(sweep, name))
    pdoc.render.configure(docformat="numpy", show_source=False)
    pdoc.pdoc("sweep", "sweep.analysis", output_directory=Path(sys.argv[1]))
    print(Path(sys.argv[1]) / "sweep.html")


if __name__ == "__main__":
    main()
