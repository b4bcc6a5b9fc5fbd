"""Run every finding under several Pythons and print what each version's OpenCV does, as Markdown.

python pipelines/opencv_findings/table.py PYTHON ...
"""

import signal
import subprocess
import sys
from pathlib import Path

FOLDER = Path(__file__).parent
VERSION = "import cv2; print(cv2.__version__)"


def outcome(python, script):
    """Return the line that a script prints, without its version; or how its process ended."""
    done = subprocess.run([python, script], capture_output=True, text=True, check=False)
    if done.returncode < 0:
        return f"the process dies ({signal.Signals(-done.returncode).name})"
    if done.returncode:
        return done.stderr.strip().splitlines()[-1]
    return done.stdout.strip().split(": ", 1)[1]


def main(pythons):
    versions = [
        subprocess.run([python, "-c", VERSION], capture_output=True, text=True, check=True).stdout
        .strip() for python in pythons
    ]
    print("| script | OpenCV | found |\n| --- | --- | --- |")
    for script in sorted(FOLDER.glob("*.py")):
        if script.name == Path(__file__).name:
            continue
        by_outcome = {}
        for python, version in zip(pythons, versions, strict=True):
            by_outcome.setdefault(outcome(python, script), []).append(version)
        name = f"[`{script.stem}`]({script.name})"
        for text, found_in in by_outcome.items():
            print(f"| {name} | {', '.join(found_in)} | {text.replace('|', '/')} |", flush=True)
            name = ""


if __name__ == "__main__":
    main(sys.argv[1:] or [sys.executable])
